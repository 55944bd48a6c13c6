"""The alignment term against NumPy: value, gradient and Gauss-Newton product of entries, and their curvature."""

from dataclasses import replace

import numpy as np
import pytest

from tests.kernels.test_contour import BODY, RIG, some_poses
from tk.kernels import alignment as a
from tk.kernels.nearest import SurfaceIndex
from tk.kernels.objective import ObjectiveParameters
from tk.model.cues.edge_term import ContourTerm
from tk.model.cues.objective import BodyObjective

SKELETON = BODY.skeleton
D = len(SKELETON.names)
# nothing but the entries: one sample that finds no voxel, a constant
SILENT = ObjectiveParameters(0.1, 1e-6, nu=0.35, coverage_nu=0.7, coverage_weight=0.0)
INDEX = SurfaceIndex.build(np.full((1, 3), 50.0), np.full(1, -1), 0.1)
# sums of some sixty terms near 1 in double precision
EXACT = 1e-10


def kernel_of(dtype=np.float64):
    term = ContourTerm(BODY, RIG, 0.1, dtype=dtype)
    return BodyObjective(BODY, 0.7, term, dtype=dtype).kernel


@pytest.fixture(scope="module")
def kernel():
    return kernel_of()


def evaluate(kernel, poses, entries, direction=None):
    """(value, gradient, product) of the entries alone."""
    none = np.zeros((len(poses), 1), np.int32)
    *with_them, _ = kernel.evaluate(INDEX, none, none, poses, direction, SILENT, entries=entries)
    *without, _ = kernel.evaluate(INDEX, none, none, poses, direction, SILENT)
    return tuple(x - y for x, y in zip(with_them, without, strict=True))


def world(pose, segment, zero):
    """(E, 3) material points (E, 3) of segments (E,) at a pose (D,)."""
    T = SKELETON.segment_transforms(pose)[segment]
    return np.einsum("eij,ej->ei", T[:, :3, :3], zero) + T[:, :3, 3]


def midpoints(pose, segment, entries):
    """(E, 2) midpoints of the points' images, (E,) True where both are in front of the camera."""
    ends = [world(pose, segment, entries[:, first : first + 3]) for first in (a.POINT_A, a.POINT_B)]
    pixels, front = np.zeros((len(entries), 2)), np.ones(len(entries), bool)
    for e, row in enumerate(entries):
        camera = RIG[int(row[a.CAMERA])]
        for x in (ends[0][e], ends[1][e]):
            front[e] &= (camera.rotation @ x + camera.translation)[2] > 1e-3
            pixels[e] += camera.project(x[None])[0][0] / 2
    return pixels, front


def value_oracle(pose, segment, entries):
    pixels, front = midpoints(pose, segment, entries)
    r = pixels - entries[:, a.TARGET : a.TARGET + 2]
    across = np.sum(r * entries[:, a.NORMAL : a.NORMAL + 2], axis=1)
    e = 0.5 * across**2 * entries[:, a.INV_SIGMA2]
    rho = np.where(front, 1 - np.exp(-e / entries[:, a.NU]), 1.0)
    state = entries[:, a.STATE]
    return np.sum(entries[:, a.SCALE] * np.where(state == a.ASSIGNED, rho, state == a.UNASSIGNABLE))


class Scene:
    """Entries of two points on one segment each, targets some pixels off, all states; and poses."""

    def __init__(self, seed, poses=1, count=60):
        rng = np.random.default_rng(seed)
        self.poses = some_poses(poses, seed)
        self.direction = rng.normal(size=(poses, D))
        self.segment = rng.choice(np.unique(BODY.segment), (poses, count))
        entries = np.zeros((poses, count, a.ENTRY_NUMBERS))
        for b in range(poses):
            for e in range(count):
                first, second = rng.choice(np.flatnonzero(BODY.segment == self.segment[b, e]), 2)
                entries[b, e, a.POINT_A : a.POINT_A + 3] = BODY.points[first]
                # every other entry is one point twice
                entries[b, e, a.POINT_B : a.POINT_B + 3] = BODY.points[second if e % 2 else first]
        entries[..., a.LAST_DOF] = SKELETON.segment_dof[self.segment]
        entries[..., a.CAMERA] = rng.integers(0, len(RIG), (poses, count))
        turn = rng.uniform(0, 2 * np.pi, (poses, count))
        entries[..., a.NORMAL], entries[..., a.NORMAL + 1] = np.cos(turn), np.sin(turn)
        entries[..., a.INV_SIGMA2] = 1 / rng.uniform(10, 40, (poses, count)) ** 2
        entries[..., a.STATE] = rng.choice([a.ABSENT, a.ASSIGNED, a.UNASSIGNABLE], (poses, count), p=[0.1, 0.8, 0.1])
        entries[..., a.SCALE] = rng.uniform(0, 2 / count, (poses, count))
        entries[..., a.NU] = rng.uniform(0.1, 1, (poses, count))
        for b in range(poses):
            pixels, _ = midpoints(self.poses[b], self.segment[b], entries[b])
            entries[b, :, a.TARGET : a.TARGET + 2] = pixels + rng.normal(0, 8, (count, 2))
        self.entries = entries

    def oracle(self, b, pose=None):
        return value_oracle(self.poses[b] if pose is None else pose, self.segment[b], self.entries[b])


def test_value(kernel):
    scene = Scene(0, poses=3)
    value = evaluate(kernel, scene.poses, scene.entries)[0]
    np.testing.assert_allclose(value, [scene.oracle(b) for b in range(3)], rtol=0, atol=EXACT)
    assert len(set(np.round(value, 6))) == 3


def test_gradient_by_central_differences(kernel):
    """Of the oracle, and of the kernel itself, with the entries held (eq. 15)."""
    scene = Scene(0)
    gradient = evaluate(kernel, scene.poses, scene.entries)[1][0]
    h = 1e-6
    steps = np.concatenate([h * np.eye(D), -h * np.eye(D)])
    poses = scene.poses + steps
    own = evaluate(kernel, poses, np.repeat(scene.entries, 2 * D, 0))[0]
    np.testing.assert_allclose(gradient, (own[:D] - own[D:]) / (2 * h), rtol=1e-6, atol=1e-7)
    theirs = np.array([scene.oracle(0, pose) for pose in poses])
    np.testing.assert_allclose(gradient, (theirs[:D] - theirs[D:]) / (2 * h), rtol=1e-6, atol=1e-7)
    assert np.mean(np.abs(gradient) > 1e-6) > 0.9, "degrees of freedom that nothing pulls test nothing"


def gauss_newton(scene, b, floor=0.0):
    """(D, D) Σ scale ρ'(e)/σ² Jᵀ n nᵀ J, J by central differences of the midpoints; outliers weigh ``floor``."""
    pose, entries, segment = scene.poses[b], scene.entries[b], scene.segment[b]
    h = 1e-6
    J = np.stack(
        [
            (midpoints(pose + d, segment, entries)[0] - midpoints(pose - d, segment, entries)[0]) / (2 * h)
            for d in h * np.eye(D)
        ],
        axis=-1,
    )
    pixels, front = midpoints(pose, segment, entries)
    n = entries[:, a.NORMAL : a.NORMAL + 2]
    r = np.sum((pixels - entries[:, a.TARGET : a.TARGET + 2]) * n, axis=1)
    inv_sigma2, nu = entries[:, a.INV_SIGMA2], entries[:, a.NU]
    decay = np.exp(-0.5 * r**2 * inv_sigma2 / nu)
    weight = entries[:, a.SCALE] * np.maximum(decay, floor) / nu * inv_sigma2
    weight = weight * front * (entries[:, a.STATE] == a.ASSIGNED)
    across = np.einsum("eik,ei->ek", J, n)
    return across.T @ (weight[:, None] * across)


def test_product_is_gauss_newtons(kernel):
    scene = Scene(5, poses=2)
    product = evaluate(kernel, scene.poses, scene.entries, scene.direction)[2]
    for b in range(2):
        np.testing.assert_allclose(product[b], gauss_newton(scene, b) @ scene.direction[b], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("floor", [0.0, 0.4])
def test_curvature_is_j_transposed_j(kernel, floor):
    scene = Scene(6)
    none = np.zeros((1, 1), np.int32)
    held = kernel.evaluate(INDEX, none, none, scene.poses, None, SILENT, entries=scene.entries)[3]
    linear = kernel.linearise(INDEX, none[0], none[0], scene.poses[0], held, SILENT, floor, entries=scene.entries)
    expected = gauss_newton(scene, 0, floor)
    np.testing.assert_allclose(linear.hessian, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_array_equal(linear.hessian, linear.hessian.T)
    assert np.linalg.eigvalsh(linear.hessian).min() > -1e-9 * np.abs(expected).max()


def test_states(kernel):
    """Padding counts nothing; a point that can have no edge costs its share and pulls nowhere (6.1.2)."""
    scene = Scene(7)
    absent, hidden = scene.entries.copy(), scene.entries.copy()
    absent[..., a.STATE], hidden[..., a.STATE] = a.ABSENT, a.UNASSIGNABLE
    for entries, cost in ((absent, 0.0), (hidden, hidden[..., a.SCALE].sum())):
        value, gradient, product = evaluate(kernel, scene.poses, entries, scene.direction)
        np.testing.assert_allclose(value, cost, rtol=0, atol=EXACT)
        assert not gradient.any() and not product.any()


def test_points_behind_the_camera_cost_all_and_pull_nowhere(kernel):
    scene = Scene(8)
    scene.entries[..., a.STATE] = a.ASSIGNED
    camera = RIG[0]
    scene.entries[..., a.CAMERA] = 0
    behind = scene.poses.copy()
    behind[0, :3] = camera.center - 3 * camera.rotation[2]  # metres behind it, along its optical axis
    value, gradient, _ = evaluate(kernel, behind, scene.entries)
    np.testing.assert_allclose(value, scene.entries[..., a.SCALE].sum(), rtol=0, atol=EXACT)
    assert not gradient.any()


def test_entries_share_tasks_with_samples_and_voxels(kernel):
    """Neither the number of entries nor of other points changes what an entry gives."""
    scene = Scene(9, count=130)
    whole = evaluate(kernel, scene.poses, scene.entries, scene.direction)
    parts = [evaluate(kernel, scene.poses, part, scene.direction) for part in np.array_split(scene.entries, 7, axis=1)]
    for all_at_once, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        np.testing.assert_allclose(all_at_once, np.sum(pieces, axis=0), rtol=0, atol=1e-9)
    many = np.zeros((1, 117), np.int32)
    case = replace(SILENT, coverage_weight=1.0)
    both = kernel.evaluate(INDEX, many, many, scene.poses, scene.direction, case, entries=scene.entries)
    np.testing.assert_allclose(both[0] - 2, whole[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(both[1], whole[1], rtol=0, atol=1e-9)


def test_single_precision_agrees_with_double(kernel):
    scene = Scene(10, poses=2)
    double = evaluate(kernel, scene.poses, scene.entries, scene.direction)
    single = evaluate(kernel_of(np.float32), scene.poses, scene.entries, scene.direction)
    for s, d in zip(single, double, strict=True):
        np.testing.assert_allclose(s, d, rtol=0, atol=3e-4 * max(np.abs(d).max(), 1))
