"""The landmarks' likelihood and their information about the points, against a straightforward NumPy oracle."""

from __future__ import annotations

import numpy as np
import pytest

from tk.kernels.kinematics import pack_tree
from tk.kernels.landmark_terms import LandmarkArrays, landmark_costs, landmark_information

V, L, D = 3, 4, 6
BONES = np.array([[0, 1, 0.9], [2, 3, 0.6]])
HALF = np.array([0, 0, 1, 1, 0, 1], np.int32)
# density of wrong ones, exchanged, the person and somebody else, precision, share that counts, nearest, 2π
NUMBERS = np.array([2.0, 0.05, np.log(0.98), np.log(0.02), 1.0, 0.5, 0.1, 2 * np.pi])


def arrays(rng: np.random.Generator, frames: int) -> LandmarkArrays:
    """Landmarks near the points of a small tree: three translations, then three angles."""
    axis = np.concatenate([np.eye(3), np.eye(3)])
    tree = pack_tree(
        axis, np.zeros((D, 3)), np.zeros((D, 3)), np.arange(D) < 3, np.arange(-1, D - 1)
    )  # a chain, whose parents come before their children
    place = rng.normal(0.0, 0.4, (L, 3))
    cameras = np.zeros((frames, V, 15))
    for f in range(frames):
        for v in range(V):
            R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            sight = rng.normal(size=3)
            cameras[f, v, :12] = np.column_stack([R, [0.1 * v, 0.2, 3.0]]).ravel()
            cameras[f, v, 12:] = sight / np.linalg.norm(sight)
    named = rng.normal(0.0, 0.08, (frames, V, 2, L, 2))
    right = rng.uniform(0.0, 0.95, (frames, V, 2, L, 1)) * (rng.random((frames, V, 2, L, 1)) > 0.2)
    marks = np.concatenate([named, right, rng.uniform(100.0, 2000.0, right.shape)], axis=-1)
    depth = rng.normal(0.0, 0.3, (frames, V, 2, len(BONES), 1))
    sure = rng.uniform(0.0, 0.9, depth.shape)
    depths = np.concatenate([depth, sure, rng.uniform(50.0, 300.0, depth.shape)], axis=-1)
    points = np.column_stack([place, [2, 3, 4, 5]])
    offset = rng.uniform(1e-4, 1e-3, (frames, L + len(BONES)))
    return LandmarkArrays(tree, points, BONES, HALF, cameras, marks, depths, offset)


def points_at(seen: LandmarkArrays, pose: np.ndarray) -> np.ndarray:
    """The points (L, 3) at a pose (D,): translations, then rotations about the axes of the moved origin."""
    result = []
    for *place, dof in seen.points:
        x = np.array(place)
        for k in range(int(dof), 2, -1):
            w = np.eye(3)[k - 3]
            K = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
            x = x + np.sin(pose[k]) * K @ x + (1 - np.cos(pose[k])) * K @ K @ x
        result.append(x + pose[:3])
    return np.array(result)


def compared(seen: LandmarkArrays, numbers: np.ndarray, f: int, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Negative logarithm of the likelihood, information (N, 3, 3) and pull (N, 3) with the points at x (L, 3)."""
    wrong, exchanged, shown, elsewhere, precision, _, nearest, _ = numbers
    N = len(HALF)
    cost, information, pull = 0.0, np.zeros((N, 3, 3)), np.zeros((N, 3))
    for v in range(V):
        T, sight = seen.cameras[f, v, :12].reshape(3, 4), seen.cameras[f, v, 12:]
        halves, said = np.array([[1 - exchanged] * 2, [exchanged] * 2]), []
        for a in range(2):
            for n in range(N):
                if n < L:
                    q, right = T[:, :3] @ x[n] + T[:, 3], seen.marks[f, v, a, n, 2]
                    if q[2] <= nearest:
                        q[2], right = 1.0, 0.0
                    w = precision * seen.marks[f, v, a, n, 3]
                    away = seen.marks[f, v, a, n, :2] * q[2] - q[:2]
                    rows = T[:2, :3] - np.outer(q[:2] / q[2], T[2, :3])
                    density = w / (2 * np.pi) * np.exp(-0.5 * w * away @ away)
                else:
                    start, end, share = BONES[n - L]
                    depth, right, w = seen.depths[f, v, a, n - L] * [1, 1, precision]
                    away = np.array([depth - share * sight @ (x[int(end)] - x[int(start)])])
                    rows, density = sight[None], np.sqrt(w / (2 * np.pi)) * np.exp(-0.5 * w * away[0] ** 2)
                both = right * density + (1 - right) * wrong
                halves[a, HALF[n]] *= both / wrong
                said.append((a, n, right * density / both * w, rows, away))
        person = np.log(halves.sum(axis=0)).sum() + shown
        total = np.logaddexp(person, elsewhere)
        cost -= total
        sure = halves / halves.sum(axis=0) * np.exp(person - total)
        for a, n, w, rows, away in said:
            information[n] += sure[a, HALF[n]] * w * rows.T @ rows
            pull[n] += sure[a, HALF[n]] * w * rows.T @ away
    return cost, information, pull


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("widened", [False, True])
def test_information_and_cost_are_those_of_the_oracle(frames: int, widened: bool) -> None:
    rng = np.random.default_rng(frames)
    seen, poses = arrays(rng, frames), rng.normal(0.0, 0.3, (4, D))
    poses[3, :3] += 5.0 * seen.cameras[min(3, frames - 1), 0, 8:11]  # behind one camera or far before it
    poses[2, :3] -= 5.0 * seen.cameras[min(2, frames - 1), 1, 8:11]
    numbers = NUMBERS.copy()
    if widened:
        numbers[3:5] = -np.inf, 1 / 16
    cost = landmark_costs(seen, numbers, poses)
    information, pull, _ = landmark_information(seen, numbers, poses)
    for b, pose in enumerate(poses):
        f = b if frames > 1 else 0
        x, offset = points_at(seen, pose), seen.offset[f]
        plain, W, p = compared(seen, numbers, f, x)
        inverse = np.linalg.inv(np.eye(3) + offset[:, None, None] * W)
        np.testing.assert_allclose(information[b].transpose(2, 0, 1), 0.5 * inverse @ W, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(pull[b].T, 0.5 * (inverse @ p[..., None])[..., 0], rtol=1e-9, atol=1e-9)
        step = offset[:L, None] * (inverse @ p[..., None])[:L, :, 0]
        moved = compared(seen, numbers, f, x + step)[0] + 0.5 * (step**2 / offset[:L, None]).sum()
        volume = -0.5 * np.linalg.slogdet(inverse[:L])[1].sum()
        assert cost[b] == pytest.approx(0.5 * (min(moved, plain) + volume), rel=1e-9)


def test_jacobian_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(5)
    seen, pose = arrays(rng, 1), rng.normal(0.0, 0.5, D)
    jacobian = landmark_information(seen, NUMBERS, pose[None])[2][0]
    for k, step in enumerate(1e-6 * np.eye(D)):
        expected = (points_at(seen, pose + step) - points_at(seen, pose - step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, k], expected, atol=1e-8)


def test_landmarks_of_another_number_of_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="landmarks of 4 frames, and 3 poses"):
        landmark_costs(arrays(np.random.default_rng(0), 4), NUMBERS, np.zeros((3, D)))
