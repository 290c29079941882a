"""Many searches side by side, whose questions are answered together."""

import concurrent.futures
import queue
from collections.abc import Callable, Sequence


def run_in_lockstep(tasks: Sequence[Callable], answer: Callable[[dict], dict]) -> list:
    """The results of tasks, each a function of `ask`, run side by side.

    Their next questions are answered together, in this thread: one call of a compiled program costs
    about as much for many designs as for one. `answer` takes {task: question}, and may leave some
    unanswered, which it gets again with the next questions of the tasks that it answers.
    """
    requests, replies = queue.SimpleQueue(), [queue.SimpleQueue() for _ in tasks]

    def run(i):
        def ask(question):
            requests.put((i, question))
            reply = replies[i].get()
            if isinstance(reply, BaseException):
                raise reply
            return reply

        try:
            return tasks[i](ask)
        finally:
            requests.put((i, None))

    with concurrent.futures.ThreadPoolExecutor(max(1, len(tasks))) as pool:
        results = [pool.submit(run, i) for i in range(len(tasks))]
        questions, due = {}, len(tasks)
        try:
            while due:
                questions |= dict(requests.get() for _ in range(due))
                questions = {i: questions[i] for i in sorted(questions) if questions[i] is not None}
                answers = answer(questions) if questions else {}
                for i, reply in answers.items():
                    del questions[i]
                    replies[i].put(reply)
                due = len(answers)
        except BaseException as error:  # the others wait for a reply
            for reply in replies:
                reply.put(error)
            raise
        return [result.result() for result in results]
