"""Many searches side by side, whose questions are answered together."""

import concurrent.futures
import queue
from collections.abc import Callable, Sequence


def in_lockstep(tasks: Sequence[Callable], answer: Callable[[dict], dict]) -> list:
    """The results of tasks, each a function of `ask`, run side by side.

    What all of them ask next is answered at once, in this thread: one call of a compiled program
    costs about as much for many designs as for one. `answer` takes {task: question}, and may leave
    some to be asked again with those of the tasks that it answers.
    """
    asked, replies = queue.SimpleQueue(), [queue.SimpleQueue() for _ in tasks]

    def run(i):
        def ask(question):
            asked.put((i, question))
            reply = replies[i].get()
            if isinstance(reply, BaseException):
                raise reply
            return reply

        try:
            return tasks[i](ask)
        finally:
            asked.put((i, None))

    with concurrent.futures.ThreadPoolExecutor(max(1, len(tasks))) as pool:
        results = [pool.submit(run, i) for i in range(len(tasks))]
        questions, due = {}, len(tasks)
        try:
            while due:
                questions |= dict(asked.get() for _ in range(due))
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
