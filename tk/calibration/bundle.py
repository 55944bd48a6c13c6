"""Bundle adjustment: intrinsics and poses of cameras, and poses of the board, from the board's points in images.

Levenberg-Marquardt on the project's block least squares: each instant's board pose is a block, the cameras are the
shared unknowns. The loss is Cauchy's, by iterated weights, so that wrong points count little.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.calibration.lens import Model, prior, project
from tk.calibration.poses import Pose, cross
from tk.optim.trajectory import Equations, Reduced

Float = NDArray[np.float64]

#: precision of an unknown that is held
_HELD = 1e14
#: Cauchy's scale in standard deviations: its 95 % efficiency on normal noise
_CAUCHY = 2.385
#: iterations, and relative decrease of the cost below which they end
_MOST_ROUNDS, _ENOUGH = 60, 1e-7
#: time between the images of one instant, frames: synchronised videos are within half a frame of each other
UNSYNCHRONISED = 0.29  # standard deviation of a uniform distribution of that width
#: least share of a part's information about its focal length that the other unknowns do not explain
_TOLD = 1e-6
#: least noise of a point, pixels
_LEAST_NOISE_PX = 0.02


@dataclass(frozen=True)
class View:
    """The board in one image of one camera."""

    camera: int
    instant: int  # images of the same instant show the same pose of the board
    points: Float  # (N, 3) on the board, metres
    pixels: Float  # (N, 2)
    ids: NDArray[np.int64]  # (N,) numbers of the points
    motion_px: float = 0.0  # motion of the board in the image from this frame to the next


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera, and their prior."""

    model: Model
    values: Float  # (K,) see tk.calibration.lens
    start: Float  # (K,) mean of the prior
    width: int  # of the image, pixels
    focal_sigma: float  # standard deviation of the prior of the logarithm of the focal length
    held: NDArray[np.bool_]  # (K,) intrinsics that stay as they are


@dataclass(frozen=True)
class State:
    """An estimate."""

    lenses: tuple[Lens, ...]
    cameras: tuple[Pose, ...]  # world to camera
    boards: Mapping[int, Pose]  # board to world, by instant

    def pose(self, view: View) -> Pose:
        """Return the pose of the board in a view's camera."""
        return self.cameras[view.camera] @ self.boards[view.instant]

    def errors(self, view: View) -> Float:
        """Return (N, 2) detected minus projected pixels of a view's points."""
        lens = self.lenses[view.camera]
        return np.asarray(view.pixels - project(lens.model, lens.values, self.pose(view).apply(view.points))[0])


@dataclass(frozen=True)
class Part:
    """Views of a camera in which its focal length may be another one."""

    camera: int
    instants: frozenset[int]


@dataclass(frozen=True)
class Solved:
    """An adjusted estimate.

    Attributes:
        state: the estimate.
        noise_px: standard deviation of a point's pixel along one axis.
        reduced: normal equations of the shared unknowns at the estimate, in units of the noise.
        slices: of each camera in the shared unknowns: 6 of the pose (rotation, translation), then its intrinsics.
    """

    state: State
    noise_px: float
    reduced: Reduced
    slices: tuple[slice, ...]

    def covariance(self) -> Float:
        """Return (S, S) covariance of the shared unknowns, the larger of two along each eigenvector.

        One assumes independent errors of the points. The other lets the errors of an instant depend on each other, as
        they do if the board is bent or moved, or the lens model is wrong (White 1980; Liang & Zeger 1986).
        """
        S = len(self.reduced.hessian)
        scale = 1 / np.sqrt(np.diag(self.reduced.hessian))
        plain = np.linalg.pinv(self.reduced.hessian * np.outer(scale, scale), rcond=1e-14, hermitian=True)
        plain *= np.outer(scale, scale)
        scores = self.reduced.by_block
        n = max(len(scores) - 1, 1)
        clustered = plain @ (scores.T @ scores) @ plain * (len(scores) / n)
        root = np.linalg.cholesky(plain + 1e-18 * np.eye(S) * np.trace(plain))
        inner = np.linalg.solve(root, np.linalg.solve(root, clustered).T)
        values, vectors = np.linalg.eigh((inner + inner.T) / 2)
        wide = root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root.T
        return np.asarray((wide + wide.T) / 2)


def focal_changes(solved: Solved, views: Sequence[View], parts: Sequence[Part]) -> Float:
    """Return (P, 2) by how much the logarithm of the focal length of each part's camera is larger in that part than in
    its other views, and its standard deviation if errors are independent; NaN where the views do not tell.

    It is one step of the adjustment with one more unknown.
    """
    problem = _Problem(views, solved.slices, sorted(solved.state.boards))
    reduced = problem.equations(solved.state, solved.noise_px, parts).reduced()
    S = solved.slices[-1].stop
    scale = 1 / np.sqrt(np.diag(reduced.hessian)[:S])
    inner = np.linalg.pinv(reduced.hessian[:S, :S] * np.outer(scale, scale), rcond=1e-14, hermitian=True)
    inner = inner * np.outer(scale, scale)
    found = np.full((len(parts), 2), np.nan)
    for k in range(len(parts)):
        across = inner @ reduced.hessian[:S, S + k]
        own = float(reduced.hessian[S + k, S + k] - reduced.hessian[S + k, :S] @ across)
        if own > _TOLD * reduced.hessian[S + k, S + k]:
            scores = reduced.by_block[:, S + k] - reduced.by_block[:, :S] @ across
            found[k] = scores.sum() / own, 1 / np.sqrt(own)
    return found


def adjust(start: State, views: Sequence[View], noise_px: float = 1.0) -> Solved:
    """Adjust an estimate to the views. The first camera stays where it is; see :class:`State` for the unknowns.

    Args:
        start: the estimate.
        views: of cameras and instants that ``start`` has.
        noise_px: noise of a point to begin with; it is estimated from the residuals.
    """
    slices, at = [], 0
    for lens in start.lenses:
        slices.append(slice(at, at + 6 + lens.model.size))
        at += 6 + lens.model.size
    problem = _Problem(views, tuple(slices), sorted(start.boards))
    state = start
    for k in range(4):  # the noise and the estimate depend on each other
        state = _descend(problem, state, noise_px)
        found = _noise(problem, state)
        settled = k > 0 and abs(found / noise_px - 1) < 0.1
        noise_px = found
        if settled:
            break
    return Solved(state, noise_px, problem.equations(state, noise_px).reduced(), problem.slices)


def _descend(problem: _Problem, state: State, noise_px: float) -> State:
    damping, cost = 1e-3, problem.cost(state, noise_px)
    for _ in range(_MOST_ROUNDS):
        equations = problem.equations(state, noise_px)
        while True:
            try:
                moved = problem.moved(state, *equations.reduced(damping).step())
                new = problem.cost(moved, noise_px)
            except np.linalg.LinAlgError:
                moved, new = state, np.inf
            if np.isfinite(new) and new <= cost:
                break
            damping *= 8
            if damping > 1e8:
                return state
        done = cost - new < _ENOUGH * max(cost, 1e-9)
        state, cost, damping = moved, new, max(damping / 8, 1e-9)
        if done:
            break
    return state


def _noise(problem: _Problem, state: State) -> float:
    """Return the robust standard deviation of the residuals along one axis, pixels, motion removed."""
    found = [errors / np.sqrt(1 + (own.blur_px / 0.3) ** 2)[:, None] for own, errors in problem.errors(state)]
    return max(float(1.4826 * np.median(np.abs(np.concatenate(found)))), _LEAST_NOISE_PX)


@dataclass(frozen=True)
class _Stack:
    """The points of all views of one camera.

    Attributes:
        camera: its index.
        points, pixels: (N, 3), (N, 2) as of a view.
        block: (N,) index of the board of each point.
        blur_px: (N,) standard deviation of each pixel because its image is not of the exact instant.
        views: block and points of each view.
    """

    camera: int
    points: Float
    pixels: Float
    block: NDArray[np.intp]
    blur_px: Float
    views: tuple[tuple[int, slice], ...]


class _Problem:
    """The views by camera, and the places of the unknowns."""

    def __init__(self, views: Sequence[View], slices: tuple[slice, ...], instants: list[int]) -> None:
        self.slices, self.instants = slices, instants
        block = {instant: b for b, instant in enumerate(instants)}
        self.stacks = []
        for c in range(len(slices)):
            own = [view for view in views if view.camera == c]
            if not own:
                continue
            counts = [len(view.points) for view in own]
            blocks = [block[view.instant] for view in own]
            ends = np.cumsum(counts).tolist()
            stack = _Stack(
                c,
                np.concatenate([view.points for view in own]),
                np.concatenate([view.pixels for view in own]),
                np.repeat(blocks, counts),
                np.repeat([UNSYNCHRONISED * view.motion_px for view in own], counts),
                tuple((b, slice(end - n, end)) for b, n, end in zip(blocks, counts, ends, strict=True)),
            )
            self.stacks.append(stack)

    def _projected(self, state: State, stack: _Stack, derivatives: bool) -> tuple[Float, Float]:
        """Return the pixels (N, 2) of a camera's points, and their derivatives (N, 2, 12 + K) or nothing."""
        boards = [state.boards[i] for i in self.instants]
        rotations = np.array([pose.rotation for pose in boards])[stack.block]
        moves = np.array([pose.translation for pose in boards])[stack.block]
        return linearise(
            state.lenses[stack.camera], state.cameras[stack.camera], rotations, moves, stack.points, derivatives
        )

    def errors(self, state: State) -> Iterator[tuple[_Stack, Float]]:
        """Yield detected minus projected pixels (N, 2) of each camera."""
        for stack in self.stacks:
            yield stack, stack.pixels - self._projected(state, stack, False)[0]

    def cost(self, state: State, noise_px: float) -> float:
        """Return the robust cost of an estimate, in units of the noise."""
        total = 0.0
        for stack, errors in self.errors(state):
            squared = (errors**2).sum(axis=1) / (noise_px**2 + stack.blur_px**2)
            total += 0.5 * _CAUCHY**2 * float(np.log1p(squared / _CAUCHY**2).sum())
        for lens in state.lenses:
            H, g = prior(lens.model, lens.values, lens.start, lens.width, lens.focal_sigma)
            total += 0.5 * float(g @ np.linalg.pinv(H) @ g)
        return total

    def equations(self, state: State, noise_px: float, parts: Sequence[Part] = ()) -> Equations:
        """Return the normal equations at an estimate; the last shared unknowns are the changes of parts."""
        shared = self.slices[-1].stop
        equations = Equations(len(self.instants), 6, shared + len(parts))
        for stack in self.stacks:
            pixels, rows = self._projected(state, stack, True)
            errors = stack.pixels - pixels
            variance = noise_px**2 + stack.blur_px**2
            weight = np.repeat(1 / (1 + (errors**2).sum(axis=1) / variance / _CAUCHY**2) / variance, 2)
            place = self.slices[stack.camera]
            columns = np.r_[:6, 6 + place.start : 6 + place.stop]
            for block, part in stack.views:
                twice = slice(2 * part.start, 2 * part.stop)
                flat = rows[part].reshape(-1, rows.shape[2])
                of = [
                    k for k, each in enumerate(parts)
                    if each.camera == stack.camera and self.instants[block] in each.instants
                ]  # fmt: skip
                by_focal = (flat[:, 12:14] @ state.lenses[stack.camera].values[:2])[:, None].repeat(len(of), axis=1)
                extra = 6 + shared + np.array(of, np.intp)
                equations.add(
                    np.full(len(flat), block),
                    np.concatenate([columns, extra]),
                    np.hstack([flat, by_focal]),
                    weight[twice],
                    errors[part].ravel(),
                )
        diagonal = np.einsum("ss->s", equations.prior_hessian)
        for c, (lens, place) in enumerate(zip(state.lenses, self.slices, strict=True)):
            own = slice(place.start + 6, place.stop)
            H, g = prior(lens.model, lens.values, lens.start, lens.width, lens.focal_sigma)
            equations.prior_hessian[own, own] += H
            equations.prior_gradient[own] += g
            diagonal[own][lens.held] += _HELD
            # the first camera stays; 1e-9 only keeps the equations regular
            diagonal[place.start : place.start + 6] += _HELD if c == 0 else 1e-9
        for b in range(len(self.instants)):
            equations.add_block_prior(b, np.full(6, 1e-9), np.zeros(6))
        return equations

    def moved(self, state: State, blocks: Float, shared: Float) -> State:
        """Return the estimate after a step."""
        cameras, lenses = [], []
        for pose, lens, place in zip(state.cameras, state.lenses, self.slices, strict=True):
            step = shared[place]
            cameras.append(pose.moved(_short(step[:6])))
            limit = 0.3 * lens.values[0]
            focal_and_middle = np.clip(step[6:10], -limit, limit)
            values = lens.values + np.where(lens.held, 0.0, np.concatenate([focal_and_middle, step[10:]]))
            lenses.append(replace(lens, values=values))
        boards = {i: state.boards[i].moved(_short(step)) for i, step in zip(self.instants, blocks, strict=True)}
        return State(tuple(lenses), tuple(cameras), boards)


def _short(step: Float) -> Float:
    """Return a step of a pose, shortened to half a radian and two metres."""
    return np.asarray(step / max(1.0, np.linalg.norm(step[:3]) / 0.5, np.linalg.norm(step[3:]) / 2.0))


def linearise(
    lens: Lens, camera: Pose, rotations: Float, moves: Float, points: Float, derivatives: bool = True
) -> tuple[Float, Float]:
    """Return the pixels (N, 2) of points on boards, and their derivatives (N, 2, 12 + K).

    The columns are steps of the board's pose (6), of the camera's pose (6), see :meth:`Pose.moved`, and of the camera's
    intrinsics (K).

    Args:
        lens, camera: of the camera.
        rotations, moves: (N, 3, 3), (N, 3) from each point's board to the world.
        points: (N, 3) on the boards.
        derivatives: whether to compute them; else the second array is empty.
    """
    turned = np.einsum("nij,nj->ni", rotations, points)
    seen = (turned + moves) @ camera.rotation.T
    pixels, by_point, by_lens = project(lens.model, lens.values, seen + camera.translation)
    if not derivatives:
        return pixels, np.zeros((0, 2, 0))
    by_world = by_point @ camera.rotation
    parts = [-by_world @ cross(turned), by_world, -by_point @ cross(seen), by_point, by_lens]
    return pixels, np.concatenate(parts, axis=2)
