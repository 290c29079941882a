"""Many constrained minimisations of few variables, walked side by side.

minimise f(u) subject to c(u) <= 0, for u in [0, 1]^v with v of 1 or 2. Everything the two phases
ask of the model is one function, values and Jacobian of a batch of points, so that it is compiled
once. Adam on a quadratic penalty carries every start into a basin; sequential quadratic
programming (damped BFGS, exact penalty, trust region) then lands on the constraints. With so few
variables its subproblem is solved by trying every active set. L-BFGS on a growing penalty ends in
the same optima, later and beside the constraints more often (docs/model.md).
"""

import functools
from collections.abc import Callable

import numpy as np

STEPS = 20, 40  # of the two phases
_ROUND_STEPS, _ROUNDS = 15, 8  # of quadratic programming, against harder constraints each time
_SETTLED = 1e-9  # size of the steps that are not worth taking
_GAIN = 1e-9  # share of the merit that is not worth a step
_TRIED = 10  # constraints that the active sets of one step are drawn from
_PENALTY = 100.0  # weight of the constraints; above every multiplier of a well-scaled problem


def search(
    model: Callable,
    starts: np.ndarray,
    slack: float,
    progress: bool,
    steps: tuple[int, int] = STEPS,
    refine: Callable = lambda us: False,
):
    """Improve every start; returns the end points (n, v) and a function giving the path to each.

    `model(us)` gives f (n,), c (n, k), their Jacobians (n, v) and (n, k, v). Constraints are held
    at c <= -slack, so that rounding cannot undo them. `steps` are those of the two phases. Where
    `refine(us)` says that it has changed the model, the second goes on from there.
    """
    from tqdm import tqdm

    path = [starts]
    with tqdm(total=sum(steps), desc="design", unit="step", disable=not progress) as bar:

        def advance(us, excess):
            path.append(us)
            meeting = int((excess <= 0).all(axis=1).sum())
            bar.set_postfix_str(f"{meeting} of {len(us)} meet every requirement", refresh=False)
            bar.update()

        us = _adam(model, starts, slack, steps[0], advance)
        ends = _sqp(model, us, slack, steps[1], advance)
        for _ in range(_ROUNDS):
            if not refine(ends):
                break
            bar.total += _ROUND_STEPS
            ends = _sqp(model, ends, slack, _ROUND_STEPS, advance)
        bar.update(bar.total - bar.n)
    walked = np.stack(path, axis=1)

    def path_to(i):
        moving = np.flatnonzero((walked[i] != walked[i, -1]).any(axis=1))
        return walked[i, : (moving[-1] if len(moving) else -1) + 2]

    return ends, path_to


@functools.cache
def _optimiser(steps):
    """Adam whose rate decays over so many steps; its update is one compiled program."""
    import jax
    import optax

    adam = optax.adam(optax.exponential_decay(0.04, steps, 0.1), b2=0.95)
    return jax.jit(adam.init), jax.jit(adam.update)


def _adam(model, us, slack, steps, advance):
    start, next_update = _optimiser(steps)
    state = start(us)
    for _ in range(steps):
        _, excess, slope, jacobian = model(us)
        pressed = _PENALTY * np.maximum(excess + slack, 0)
        gradient = slope + np.einsum("nk,nkv->nv", pressed, jacobian)
        # Beside an exceptional point or gross slip a derivative can be huge or overflow.
        gradient = np.where(np.isfinite(gradient), gradient, 0)
        norm = np.linalg.norm(gradient, axis=1, keepdims=True)
        update, state = next_update(gradient / np.maximum(norm, 1), state)
        us = np.clip(us + np.asarray(update), 0, 1)
        advance(us, excess)
    return us


def _evaluate(model, us):
    """Points with everything known of them: places, values, excesses, slopes and Jacobians."""
    us = np.clip(us, 0, 1)
    values, excess, slope, jacobian = model(us)
    return us, values, excess, slope, np.nan_to_num(jacobian)


def _merit(points, slack):
    _, values, excess, _, _ = points
    merit = values + _PENALTY * np.maximum(excess + slack, 0).sum(axis=1)
    return np.where(np.isfinite(merit), merit, np.inf)


def _choose(mask, points, others):
    return tuple(
        np.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y)
        for x, y in zip(points, others, strict=True)
    )


def _sqp(model, us, slack, steps, advance):
    n, v = us.shape
    hessian = np.tile(np.eye(v), (n, 1, 1))
    radius = np.full(n, 0.05)
    points = _evaluate(model, us)
    merit = _merit(points, slack)
    for _ in range(steps):
        us, _, excess, slope, jacobian = points
        low = np.maximum(-radius[:, None], -us)
        high = np.minimum(radius[:, None], 1 - us)
        step, weights, gain = _quadratic_step(slope, hessian, excess + slack, jacobian, low, high)
        if ((gain <= _GAIN * np.abs(merit)) | (radius < _SETTLED)).all():
            break
        trial = _evaluate(model, us + step)
        # Along a curved constraint the exact penalty refuses full steps (the Maratos effect):
        # a second step, with the constraints shifted to what they were at the first one.
        shifted = trial[2] - np.einsum("nkv,nv->nk", jacobian, step)
        step, _, _ = _quadratic_step(slope, hessian, shifted + slack, jacobian, low, high)
        corrected = _evaluate(model, us + step)
        trial = _choose(_merit(corrected, slack) < _merit(trial, slack), corrected, trial)

        reached = _merit(trial, slack)
        better = reached < merit
        step = trial[0] - us
        change = trial[3] - slope + np.einsum("nk,nkv->nv", weights, trial[4] - jacobian)
        hessian = np.where(better[:, None, None], _bfgs(hessian, step, change), hessian)
        full = np.abs(step).max(axis=1) > 0.9 * radius
        radius = np.where(better, np.where(full, 2 * radius, radius), radius / 3)
        radius = np.clip(radius, 1e-14, 0.3)
        points, merit = _choose(better, trial, points), np.where(better, reached, merit)
        advance(points[0], points[2])
    return points[0]


def _bfgs(hessian, step, change):
    """Powell's damped update, which keeps every matrix positive definite."""
    image = np.einsum("nij,nj->ni", hessian, step)
    along = np.einsum("ni,ni->n", step, image)
    curvature = np.einsum("ni,ni->n", step, change)
    short = curvature < 0.2 * along
    with np.errstate(divide="ignore", invalid="ignore"):
        theta = np.where(short, 0.8 * along / (along - curvature), 1)[:, None]
        mixed = theta * change + (1 - theta) * image
        updated = (
            hessian
            - image[:, :, None] * image[:, None, :] / along[:, None, None]
            + mixed[:, :, None]
            * mixed[:, None, :]
            / np.einsum("ni,ni->n", step, mixed)[:, None, None]
        )
    # Steps of no length and multipliers at their limit can spoil it: then start over.
    identity = np.broadcast_to(np.eye(step.shape[1]), updated.shape)
    finite = np.isfinite(updated).all(axis=(1, 2), keepdims=True)
    spectrum = np.linalg.eigvalsh(np.where(finite, updated, identity))
    sound = finite[:, 0, 0] & (spectrum[:, 0] > 1e-4) & (spectrum[:, -1] < 1e3)
    return np.where(sound[:, None, None], updated, identity)


def _quadratic_step(slope, hessian, excess, jacobian, low, high):
    """The step of the quadratic model with linear constraints that has the least exact penalty.

    Every set of at most v constraints, the faces of low <= p <= high (n, v) among them, is tried
    as the active one; those faces are never left. Of many constraints only those that can come
    closest to being violated inside the faces are tried, but all of them are judged.
    Where no step has less penalty than staying has, the step is none. Returns steps (n, v), the
    multipliers of the requirements (n, k), and by how much the steps lessen the penalty (n,).
    """
    n, k, v = jacobian.shape
    tried = min(k, _TRIED)
    reach = excess + np.einsum("nkv,nv->nk", np.abs(jacobian), np.maximum(high, -low))
    near = np.sort(np.argpartition(-reach, tried - 1, axis=1)[:, :tried], axis=1)
    chosen_rows = np.take_along_axis(jacobian, near[..., None], axis=1)
    faces = np.concatenate([np.eye(v), -np.eye(v)])
    rows = np.concatenate([chosen_rows, np.tile(faces, (n, 1, 1))], axis=1)
    bounds = np.concatenate([-np.take_along_axis(excess, near, axis=1), high, -low], axis=1)
    # Active set A: p = -B^-1 (g + A' w) with A B^-1 A' w = -(b + A B^-1 g).
    inverse = np.linalg.inv(hessian)
    free = -np.einsum("nij,nj->ni", inverse, slope)
    image = rows @ inverse
    schur = image @ rows.transpose(0, 2, 1)
    right = np.einsum("nri,ni->nr", rows, free) - bounds

    # Parallel or vanishing rows: their steps come out huge, and lose below.
    own = np.einsum("nrr->nr", schur)
    single = right / (own + 1e-200)
    steps = [free[:, None], free[:, None] - image * single[..., None]]
    i, j = np.triu_indices(tried + 2 * v, 1) if v == 2 else (np.arange(0), np.arange(0))
    guard = 1e-14 * (own[:, i] + own[:, j]) + 1e-200
    p, q, r = own[:, i] + guard, own[:, j] + guard, schur[:, i, j]
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (q * right[:, i] - r * right[:, j]) / (p * q - r**2)
        second = (p * right[:, j] - r * right[:, i]) / (p * q - r**2)
        steps.append(
            free[:, None] - image[:, i] * first[..., None] - image[:, j] * second[..., None]
        )
    steps = np.clip(np.nan_to_num(np.concatenate(steps, axis=1)), low[:, None], high[:, None])
    penalty = (
        np.einsum("nv,nsv->ns", slope, steps)
        + np.einsum("nsi,nij,nsj->ns", steps, hessian, steps) / 2
        + _PENALTY
        * np.maximum(excess[:, None] + np.einsum("nkv,nsv->nsk", jacobian, steps), 0).sum(axis=2)
    )
    penalty = np.where(np.isfinite(penalty), penalty, np.inf)
    best, every = penalty.argmin(axis=1), np.arange(n)
    gain = _PENALTY * np.maximum(excess, 0).sum(axis=1) - penalty[every, best]
    members = tried + 2 * v
    pair = best - 1 - members
    weight = np.zeros((n, members))
    alone = (best > 0) & (pair < 0)
    weight[alone, best[alone] - 1] = single[alone, best[alone] - 1]
    both = pair >= 0
    weight[both, i[pair[both]]] = first[both, pair[both]]
    weight[both, j[pair[both]]] = second[both, pair[both]]
    weights = np.zeros((n, k))
    np.put_along_axis(weights, near, weight[:, :tried], axis=1)
    step = np.where(gain[:, None] > 0, steps[every, best], 0)
    return step, np.clip(np.nan_to_num(weights), 0, _PENALTY), np.maximum(gain, 0)
