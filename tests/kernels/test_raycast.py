"""Rays through a cone body against NumPy that intersects every ray with every part."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import BODY
from tests.model.ring import ring_of_cameras
from tk.kernels.cones import CONE
from tk.kernels.projection import pack_cameras
from tk.kernels.raycast import FAR, Cast, Rays, cast, costs, nothing
from tk.model.body import gait_poses as gait
from tk.model.body.cone_body import COLOR_GROUPS, ConeBody
from tk.model.body.skeleton import CHAINS, SEGMENTS
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import pixel_rays

RIG = ring_of_cameras(3, width=160, height=200)
STEP = 4
RAYS = pixel_rays(RIG, STEP)
V, H, W = RAYS.shape[:3]
# By so much a part may be larger or smaller before a ray counts as one that meets it for sure.
GRAZE = 5e-3


def poses_of(count: int) -> np.ndarray:
    poses = np.array([gait.walking_pose(BODY.skeleton, i / count) for i in range(count)])
    poses += np.random.default_rng(4).normal(0, 0.15, poses.shape)
    poses[:, :3] = [0.05, -0.03, 0.93]
    return poses


POSES = poses_of(3)
COST = np.random.default_rng(5).uniform(0, 1, (V, H, W, len(COLOR_GROUPS) + 1)).astype(np.float32)


def entered(shape, kind, eye, rays):
    """(N,) where rays (N, 3) from ``eye`` first meet the surface of a part in its own frame; inf where never.

    All places where a ray crosses the mantle between the rims, or a cap within its rim; the first of them.
    """
    a, b, h, m = shape
    g = (m - 1) / h if kind == CONE else 0.0
    # (x/a)² + (y/b)² = (1 + g z)²  for a cone, (x/a)² + (y/b)² + (z/h)² = 1 for an ellipsoid
    scale = np.array([1 / a, 1 / b, 1 / h if kind != CONE else 0.0])
    d, e = rays * scale, eye * scale
    A = (d**2).sum(1) - (g * rays[:, 2]) ** 2
    B = (d * e).sum(1) - g * rays[:, 2] * (1 + g * eye[2])
    C = (e**2).sum() - (1 + g * eye[2]) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(B * B - A * C)
        places = [(-B - root) / A, (-B + root) / A]
        valid = []
        for t in places:
            z = eye[2] + t * rays[:, 2]
            valid.append((t > 0) & (((z >= 0) & (z <= h) & (1 + g * z > 0)) if kind == CONE else True))
        if kind == CONE:
            for z, r in ((0.0, 1.0), (h, m)):
                t = (z - eye[2]) / rays[:, 2]
                x = eye + t[:, None] * rays
                places.append(t)
                valid.append((t > 0) & ((x[:, 0] / a) ** 2 + (x[:, 1] / b) ** 2 <= r * r))
        return np.min([np.where(ok, t, np.inf) for ok, t in zip(valid, places, strict=True)], axis=0)


def brute_force(
    body: ConeBody, pose: np.ndarray, grown: float = 1.0, rig: Rig = RIG, rays_of: np.ndarray = RAYS
) -> tuple[np.ndarray, np.ndarray]:
    """Labels and depths (V, H, W) of all rays, parts larger by a factor in all directions from their middle."""
    T_segment = body.skeleton.segment_transforms(pose)
    label, depth = np.zeros((V, H, W), int), np.full((V, H, W), np.inf)
    for p, part in enumerate(body.parts):
        a, b, h, m = part.shape
        T = T_segment[SEGMENTS.index(part.segment)] @ part.T_body_part
        if part.kind == CONE:  # about the middle of its axis
            T = T @ np.block([[np.eye(3), np.array([[0, 0, 0.5 * h * (1 - grown)]]).T], [np.zeros((1, 3)), 1.0]])
        shape = (a * grown, b * grown, h * grown, m)
        for v, camera in enumerate(rig):
            rays = rays_of[v].reshape(-1, 3).astype(np.float64) @ T[:3, :3]
            t = entered(shape, part.kind, (camera.center - T[:3, 3]) @ T[:3, :3], rays).reshape(H, W)
            nearer = t < depth[v]
            depth[v][nearer], label[v][nearer] = t[nearer], p + 1
    return label, depth


GRID = Rays(pack_cameras(RIG), STEP, RAYS)


def cast_all(body: ConeBody, poses: np.ndarray, dtype: type = np.float64, **options):
    return cast(body.pack(dtype), GRID, COST, poses, **options)


def cost_of(label: np.ndarray) -> float:
    """The sum of what the labels (V, H, W) cost."""
    column = np.concatenate([[0], BODY.color_group + 1])[label]
    return float(np.take_along_axis(COST.astype(np.float64), column[..., None], axis=-1).sum())


def test_rays_meet_what_brute_force_says():
    total, met = cast_all(BODY, POSES)
    assert total.shape == (len(POSES), V)
    for b, pose in enumerate(POSES):
        label, depth = brute_force(BODY, pose)
        sure = np.ones(label.shape, bool)
        for grown in (1 - GRAZE, 1 + GRAZE):
            sure &= brute_force(BODY, pose, grown)[0] == label
        assert sure.mean() > 0.97 and len(np.unique(label[sure])) > 15
        np.testing.assert_array_equal(met.label[b][sure], label[sure])
        hit = sure & (label > 0)
        np.testing.assert_allclose(met.depth[b][hit], depth[hit], rtol=1e-5)
        assert (met.depth[b][met.label[b] == 0] == np.float32(FAR)).all()
        # what all rays cost is what the labels say, and nearly what brute force says
        assert total[b].sum() == pytest.approx(cost_of(met.label[b].astype(int)), rel=1e-5)
        assert abs(total[b].sum() - cost_of(label)) <= (~sure).sum() + 1e-3


@pytest.mark.parametrize("fisheye", [False, True])
def test_lenses_that_bend_lines_hide_no_part(fisheye: bool) -> None:
    """A limb's axis is an arc in the pictures of a wide lens near by: rays that meet it are cast all the same."""
    bent = np.array([0.05, 0.01, 0.0, 0.0]) if fisheye else np.array([-0.22, 0.03, 0.0, 0.0, 0.0])
    near = ring_of_cameras(3, width=640, height=800, radius_m=0.9)
    focal = np.diag([0.75 if fisheye else 0.8] * 2 + [1.0])
    center = np.array([[0, 0, c] for c in (319.5, 399.5)] + [[0, 0, 0]]) * (1 - focal[0, 0])
    rig = Rig(tuple(replace(c, matrix=focal @ c.matrix + center, distortions=bent, fisheye=fisheye) for c in near))
    rays = pixel_rays(rig, 4 * STEP)
    _, met = cast(BODY.pack(np.float64), Rays(pack_cameras(rig), 4 * STEP, rays), COST, POSES)
    for b, pose in enumerate(POSES):
        label = brute_force(BODY, pose, 1.0, rig, rays)[0]
        sure = np.ones(label.shape, bool)
        for grown in (1 - GRAZE, 1 + GRAZE):
            sure &= brute_force(BODY, pose, grown, rig, rays)[0] == label
        assert sure.mean() > 0.95 and len(np.unique(label[sure])) > 15
        np.testing.assert_array_equal(met.label[b][sure], label[sure])


def test_the_rest_may_be_cast_before():
    """Whatever is drawn first, limbs or the rest, all at once gives the same; poses differ in the limb only."""
    limb = np.array([p.segment in CHAINS["arm_l"] for p in BODY.parts])
    parts, others = np.flatnonzero(limb).astype(np.int32), np.flatnonzero(~limb).astype(np.int32)
    poses = np.repeat(POSES[:1], 4, axis=0)
    arm = BODY.skeleton.chain_dofs("arm_l")
    poses[:, arm] += np.random.default_rng(6).normal(0, 0.8, (4, arm.sum()))
    expected, _ = cast_all(BODY, poses, np.float32)
    for first, second in ((others, parts), (parts, others)):
        for b in range(4):
            _, rest = cast_all(BODY, poses[b : b + 1], np.float32, drawn=first)
            before = Cast(rest.label[0].copy(), rest.depth[0].copy())
            total = costs(BODY.arrays, GRID, COST, poses[b : b + 1], second, before)
            np.testing.assert_allclose(total[0], expected[b], rtol=1e-5)
            np.testing.assert_array_equal(before.label, rest.label[0], err_msg="what was before is not changed")


def test_without_export_the_costs_are_the_same_and_in_any_batch():
    with_labels, _ = cast_all(BODY, POSES, np.float32)
    without = costs(BODY.arrays, GRID, COST, POSES)
    np.testing.assert_array_equal(without, with_labels)
    np.testing.assert_array_equal(costs(BODY.arrays, GRID, COST, POSES[1:2])[0], without[1])


def test_two_columns_of_costs_suffice_without_colors():
    few = np.ascontiguousarray(COST[..., :2])
    total, met = cast(BODY.arrays, GRID, few, POSES)
    many = np.repeat(few, [1, len(COLOR_GROUPS)], axis=-1)
    np.testing.assert_array_equal(total, costs(BODY.arrays, GRID, many, POSES))
    before = Cast(met.label[0].copy(), met.depth[0].copy())
    again = costs(BODY.arrays, GRID, few, POSES[:1], before=before)
    np.testing.assert_allclose(again[0], total[0], rtol=1e-6)


def test_a_body_out_of_sight_costs_what_nothing_costs():
    away = POSES[:1].copy()
    away[:, 2] += 50.0
    total, met = cast_all(BODY, away)
    assert not met.label.any()
    np.testing.assert_allclose(total[0], COST[..., 0].sum(axis=(1, 2)), rtol=1e-5)
    empty = nothing((V, H, W))
    np.testing.assert_array_equal(empty.label, met.label[0])
    np.testing.assert_array_equal(empty.depth, met.depth[0])


def test_a_smaller_picture_has_no_rays_outside():
    narrow = Rig((RIG[0], replace(RIG[1], width=90, height=110), RIG[2]))
    rays = pixel_rays(narrow, STEP)
    outside = ~rays.any(axis=-1)
    assert outside[1].any() and not outside[[0, 2]].any()
    _, met = cast(BODY.arrays, Rays(pack_cameras(narrow), STEP, rays), COST, POSES[:1])
    assert not met.label[0][outside].any() and met.label[0][1].any()
