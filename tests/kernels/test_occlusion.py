"""Occlusion: the ray test against a dense search, and whole bodies against Open3D's ray casting of their meshes."""

import functools

import numpy as np
import pytest

from tests.kernels import oracles
from tests.model.figures import DIMENSIONS, piece_transforms, skin_of
from tk.kernels.contour import ContourKernel
from tk.kernels.occlusion import TOUCH, segment_enters
from tk.kernels.projection import pack_cameras
from tk.kernels.runtime import ensure_runtime, ti
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.strips import build_strips
from tk.model.body.superellipsoid import Superellipsoid
from tk.model.cameras.camera import Camera, Rig

# A point is grazing if moving it by this much, to any side or along the ray, changes what the mesh says.
GRAZING_M = 0.003
AGREEMENT = 0.99


@functools.cache
def _thin_kernel(real):
    @ti.kernel
    def enters(
        q: ti.types.ndarray(dtype=real, ndim=2),
        d: ti.types.ndarray(dtype=real, ndim=2),
        shape: ti.types.ndarray(dtype=real, ndim=2),  # (N, 7)
        out: ti.types.ndarray(dtype=ti.i32, ndim=1),
    ):
        for n in range(q.shape[0]):
            out[n] = segment_enters(
                ti.Vector([q[n, a] for a in ti.static(range(3))]),
                ti.Vector([d[n, a] for a in ti.static(range(3))]),
                ti.Vector([shape[n, a] for a in ti.static(range(3))]),
                shape[n, 3],
                shape[n, 4],
                shape[n, 5],
                shape[n, 6],
            )

    return enters


def enters(q, d, shape, dtype=np.float32):
    ensure_runtime()
    q, d, shape = (np.ascontiguousarray(np.atleast_2d(a), dtype) for a in (q, d, shape))
    shape = np.ascontiguousarray(np.broadcast_to(shape, (len(q), 7)))
    out = np.empty(len(q), np.int32)
    _thin_kernel(ti.f32 if dtype == np.float32 else ti.f64)(q, d, shape, out)
    return out.astype(bool)


def lowest(q, d, shape, steps=4001):
    """The least G on the part of each segment between the cutting planes; infinite where there is none."""
    result = np.full(len(q), np.inf)
    for n, (a1, a2, a3, e1, e2, z_lower, z_upper) in enumerate(shape):
        p = q[n] + np.linspace(0, 1, steps)[:, None] * d[n]
        p = p[(p[:, 2] >= z_lower) & (p[:, 2] <= z_upper)]
        if len(p):
            result[n] = oracles.implicit(p, np.array([a1, a2, a3]), e1, e2).min()
    return result


def random_segments(rng, count):
    radii = rng.uniform(0.03, 0.3, (count, 3))
    exponents = rng.uniform(0.3, 1.7, (count, 2))
    cut = np.sort(rng.uniform(-1, 1, (count, 2)), axis=1) * radii[:, 2:]
    q = rng.normal(size=(count, 3)) * 0.25
    target = rng.normal(size=(count, 3)) * 0.15  # most rays pass nearby
    return q, (target - q) * rng.uniform(0.3, 20, (count, 1)), np.column_stack([radii, exponents, cut])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_ray_enters_where_a_dense_search_finds_it_inside(dtype):
    q, d, shape = random_segments(np.random.default_rng(1), 600)
    # the dense search may step over a thin slice; the sampled ray is longer than what it can miss by this much
    least = lowest(q, d, shape)
    clear = np.abs(least - 1) > 0.01
    expected = least < 1
    got = enters(q, d, shape, dtype)
    assert clear.mean() > 0.9 and 0.2 < expected[clear].mean() < 0.8
    # a sliver cut off by the planes may be thinner than the dense search's step
    assert not (expected & ~got & clear).any(), "every point inside that the search found is found"
    assert (got & ~expected & clear).sum() <= 2


CYLINDERLIKE = [0.1, 0.1, 0.4, 0.5, 1.0, -0.2, 0.3]


@pytest.mark.parametrize(
    ("q", "end", "expected"),
    [
        ([1, 0, 0], [-1, 0, 0], True),  # straight through
        ([1, 0, 0], [0.2, 0, 0], False),  # the camera is in front of it
        ([1, 0, 0], [2, 0, 0], False),  # it is behind the point
        ([0, 0, 0.1], [5, 0, 0], True),  # the point is inside
        ([1, 0, 0.31], [-1, 0, 0.31], False),  # above the upper cut, where the whole superellipsoid would be hit
        ([1, 0, -0.21], [-1, 0, -0.21], False),
        ([0, 0, 1], [0, 0, 0.25], True),  # along the axis, through the cut's flat face
        ([0, 0, 1], [0, 0, 0.35], False),
        ([0.1, -1, 0], [0.1, 1, 0], False),  # touches the side
        ([0.1 * (1 - 4 * TOUCH), -1, 0], [0.1 * (1 - 4 * TOUCH), 1, 0], True),
        ([0.09, 0.09, -1], [0.09, 0.09, 1], False),  # through the bounding box's corner only
    ],
)
def test_cases(q, end, expected):
    assert enters(q, np.subtract(end, q), CYLINDERLIKE)[0] == expected
    turned = [q[1], q[0], q[2]], [end[1], end[0], end[2]]
    assert enters(turned[0], np.subtract(turned[1], turned[0]), CYLINDERLIKE)[0] == expected


def mesh(piece: Superellipsoid, rings=48, around=96):
    """A closed triangle mesh of a truncated piece: (V, 3) in its frame, (F, 3)."""
    eta, omega = np.linspace(*piece.eta_range, rings), np.linspace(-np.pi, np.pi, around, endpoint=False)
    side = piece.point(*np.meshgrid(eta, omega, indexing="ij")).reshape(-1, 3)
    vertices = np.vstack([side, [0, 0, piece.z_lower], [0, 0, piece.z_upper]])
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    ring = np.arange(around)
    low = np.column_stack([np.full(around, len(side)), np.roll(ring, -1), ring])
    high = np.column_stack([np.full(around, len(side) + 1), ring, np.roll(ring, -1)])
    high[:, 1:] += (rings - 1) * around
    return vertices, np.vstack(
        [np.column_stack([a, b, b + around]), np.column_stack([a, b + around, a + around]), low, high]
    )


class MeshedBody:
    """The body at one pose as an Open3D scene with a geometry for each piece."""

    def __init__(self, body, pose):
        import open3d as o3d  # takes seconds, which each worker that collects the tests would need

        self.tensor = o3d.core.Tensor
        self.scene = o3d.t.geometry.RaycastingScene()
        for piece, M in zip(body.pieces, piece_transforms(body, pose), strict=True):
            vertices, faces = mesh(piece)
            self.scene.add_triangles(
                o3d.core.Tensor((vertices @ M[:3, :3].T + M[:3, 3]).astype(np.float32)),
                o3d.core.Tensor(faces.astype(np.uint32)),
            )

    def hidden(self, p_world, own, center):
        """(N,) True where a piece other than the point's own lies between it and the camera."""
        if len(p_world) == 0:
            return np.zeros(0, bool)  # Open3D crashes on no rays
        rays = np.column_stack([np.broadcast_to(center, p_world.shape), p_world - center]).astype(np.float32)
        hits = self.scene.list_intersections(self.tensor(rays))
        ray, t, geometry = (hits[key].numpy().astype(float) for key in ("ray_ids", "t_hit", "geometry_ids"))
        ray = ray.astype(int)
        before = (t < 1) & (geometry.astype(int) != own[ray])
        return np.bincount(ray[before], minlength=len(p_world)) > 0

    def judge(self, p_world, own, center):
        """What the mesh says (N,), and where it says the same all around (N,)."""
        d = (p_world - center) / np.linalg.norm(p_world - center, axis=1, keepdims=True)
        side = np.cross(d, [0.0, 0.6, 0.8])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        answer = self.hidden(p_world, own, center)
        steady = np.ones(len(p_world), bool)
        for u in (d, side, np.cross(d, side)):
            for sign in (-1, 1):
                steady &= self.hidden(p_world + sign * GRAZING_M * u, own, center) == answer
        return answer, steady


def camera_at(position, target=(0.0, 0.0, 1.0)):
    forward = np.subtract(target, position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.1, 1.0])
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    matrix = np.array([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]])
    return Camera("c", 640, 480, matrix, np.zeros(5), R, -R @ np.asarray(position, float))


def random_pose(skeleton, rng):
    """Anywhere within the limits, upright within half a radian, about a metre above the floor."""
    lower = np.where(np.isfinite(skeleton.lower), skeleton.lower, -0.5)
    upper = np.where(np.isfinite(skeleton.upper), skeleton.upper, 0.5)
    pose = rng.uniform(lower, upper)
    pose[:3] = [*rng.uniform(-0.3, 0.3, 2), 1.0]
    return pose


def test_visible_points_are_those_that_ray_casting_sees():
    body = skin_of(DIMENSIONS)
    strips = build_strips(body, range(len(body.pieces)))
    # one close, one overhead: strong perspective
    rig = Rig(tuple(camera_at(p) for p in ([3, 0, 1.2], [-1, 2.5, 1.8], [-2, -3, 0.6], [0.3, 0.2, 3.2])))
    kernel = ContourKernel(body.arrays, strips.angles, strips.normals, strips.piece, pack_cameras(rig))
    rng = np.random.default_rng(7)
    poses = np.array([random_pose(body.skeleton, rng) for _ in range(5)])
    points = kernel(poses, np.tile(np.arange(0, len(strips.piece), 2), (len(poses), 1)))
    segment = np.array([SEGMENTS.index(piece.segment) for piece in body.pieces])
    agree = total = found_in_all = hidden_in_all = 0
    for b, pose in enumerate(poses):
        meshed = MeshedBody(body, pose)
        T = body.skeleton.segment_transforms(pose)[segment[strips.piece[points.strip[b]]]]
        for c, center in enumerate(rig.centers):
            found = points.found[b, c] == 1
            p_world = np.einsum("kij,ksj->ksi", T[:, :3, :3], points.points_zero[b, c]) + T[:, None, :3, 3]
            own = np.repeat(strips.piece[points.strip[b]][:, None], 2, 1)[found]
            hidden, steady = meshed.judge(p_world[found], own, center)
            same = (points.visible[b, c][found] == 0) == hidden
            agree += (same & steady).sum()
            total += steady.sum()
            found_in_all += found.sum()
            hidden_in_all += (points.visible[b, c][found] == 0).sum()
    hidden_share = hidden_in_all / found_in_all
    assert found_in_all > 5000 and 0.1 < hidden_share < 0.9
    assert total > 0.85 * found_in_all, "grazing points are the exception"
    assert agree >= AGREEMENT * total, f"{agree} of {total}"
