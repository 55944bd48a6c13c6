"""Refinement of cameras and clocks by a rendered person; rows against finite differences."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from tests.model.body.test_body_fit import edgels_all_over, walk
from tests.model.figures import BODY, draw_silhouettes, surface_points
from tests.model.ring import ring_of_cameras, turned
from tk.errors import ConfigError
from tk.io.captures.mask_store import MaskStore
from tk.kernels.cones import CONE
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_parameters import BodyFamily, shapes_of
from tk.model.body.cone_body import SHAPE_NUMBERS, build_cone_body, group_of
from tk.model.cameras.agreement import camera_agreement
from tk.model.cameras.bundle import TrackedPerson, bundle_frames, camera_rows, farthest
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import closest_to_lines
from tk.model.cameras.people_bundle import PeopleBundle
from tk.model.cameras.refinement import (
    MOVE_M,
    SCALES,
    TURN_DEG,
    RefinementSettings,
    aligned,
    refine_cameras,
    turn_between,
    world_motions,
)
from tk.model.masks.silhouettes import Views
from tk.run.refinement import refine_rig

RIG = ring_of_cameras(4, width=320, height=400)
FRAMES = 12
QUICK = RefinementSettings()


@cache
def motion() -> np.ndarray:
    """(F, D) a person who walks forwards and turns."""
    poses = walk(BODY, FRAMES)
    names = BODY.skeleton.names
    poses[:, names.index("torso_x")] = np.linspace(-0.4, 0.4, FRAMES)
    poses[:, names.index("torso_y")] = 0.3 * np.sin(np.linspace(0, 3, FRAMES))
    poses[:, names.index("torso_yaw")] = np.linspace(0, 2.0, FRAMES)
    return poses


def rendered(late: tuple[float, ...] = (0, 0, 0, 0)) -> MaskStore:
    """Masks of the motion; image k of a camera shows the pose of frame k + late."""
    frame = np.arange(FRAMES)
    layers = []
    for camera, delay in zip(RIG, late, strict=True):
        at = np.clip(frame + delay, 0, FRAMES - 1)
        poses = np.column_stack([np.interp(at, frame, column) for column in motion().T])
        layers.append(draw_silhouettes(BODY, Rig((camera,)), poses)[:, 0])
    store = MaskStore()
    for k, masks in enumerate(np.stack(layers, axis=1)):
        store.put(k, masks)
    return store


@cache
def in_time() -> MaskStore:
    return rendered()


def tracked(store: MaskStore, poses: np.ndarray | None = None, usable: slice = slice(None)) -> TrackedPerson:
    """All frames; only those of the slice are usable."""
    sure = np.zeros(FRAMES, bool)
    sure[usable] = True
    return TrackedPerson(BODY, store.get, np.arange(FRAMES), motion() if poses is None else poses, sure)


def frames(store: MaskStore, rig: Rig):
    return bundle_frames(tracked(store), Views(rig), FRAMES, SCALES, True)


def disturbed(camera: Camera, rng: np.random.Generator, deg: float = 0.25, metres: float = 0.01) -> Camera:
    axis, direction = rng.normal(size=(2, 3))
    turn = np.asarray(cv2.Rodrigues(np.radians(deg) * axis / np.linalg.norm(axis))[0])
    center = camera.center + metres * direction / np.linalg.norm(direction)
    return replace(camera, rotation=turn @ camera.rotation, translation=-turn @ camera.rotation @ center)


PERTURBED = Rig(tuple(disturbed(camera, np.random.default_rng(20 + i)) for i, camera in enumerate(RIG)))


def errors(rig: Rig) -> tuple[float, float]:
    """Largest errors of orientation (degrees) and centre (metres) after alignment with the true cameras."""
    rig = aligned(rig, RIG, np.radians(0.1), 0.005)
    turns = [turn_between(one, other) for one, other in zip(rig, RIG, strict=True)]
    return max(turns), float(np.linalg.norm(rig.centers - RIG.centers, axis=1).max())


# --- derivatives and gauge --------------------------------------------------------------------------------------------


def test_camera_with_empty_masks_is_consistent():
    store = MaskStore()
    for k in range(FRAMES):
        masks = in_time().get(k).copy()
        masks[2] = 0
        store.put(k, masks)
    agreement = camera_agreement([(BODY, frames(store, RIG))], RIG)
    assert np.isfinite(agreement.shift_px).all() and not agreement.inconsistent.any()


@pytest.mark.parametrize("kind", ["turn", "move", "focal", "shift"])
def test_camera_rows_equal_finite_differences(kind):
    camera = replace(RIG[1], distortions=np.array([-0.08, 0.01, 0.001, -0.002, 0.0]))
    rng = np.random.default_rng(3)
    edgels = edgels_all_over(BODY, 60)
    x = surface_points(BODY, motion()[3], edgels.part, edgels.unscaled)
    pixel, _ = camera.project(x)
    normal = rng.normal(size=(len(x), 2))
    J = np.stack([(camera.project(x + s)[0] - camera.project(x - s)[0]) / 2e-6 for s in 1e-6 * np.eye(3)], axis=2)
    edgels = edgels._replace(pixel=pixel, normal=normal, row=np.einsum("ni,nij->nj", normal, J))
    rows = camera_rows(camera, x, edgels, kind)

    def changed(row):
        if kind == "turn":
            turn = np.asarray(cv2.Rodrigues(row)[0])
            return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
        if kind == "move":
            return replace(camera, translation=camera.translation + row)
        K = camera.matrix.copy()
        if kind == "focal":
            K[[0, 1], [0, 1]] *= np.exp(row[0])
        else:
            K[:2, 2] += row
        return replace(camera, matrix=K)

    for k, step in enumerate(1e-5 * np.eye(rows.shape[1])):
        moved = (changed(step).project(x)[0] - changed(-step).project(x)[0]) / 2e-5
        np.testing.assert_allclose(rows[:, k], np.einsum("ni,ni->n", normal, moved), rtol=1e-4, atol=1e-3)


def test_motions_of_the_world_change_no_image():
    modes = world_motions(RIG).reshape(len(RIG), 6, 7)
    x = np.random.default_rng(1).uniform([-0.5, -0.5, 0], [0.5, 0.5, 1.8], (30, 3))
    for k in range(7):
        a, b, s = 1e-6 * np.eye(7)[k, :3], 1e-6 * np.eye(7)[k, 3:6], 1e-6 * np.eye(7)[k, 6]
        world = x + np.cross(a, x) + b + s * x
        for camera, mode in zip(RIG, modes, strict=True):
            turn = np.asarray(cv2.Rodrigues(1e-6 * mode[:3, k])[0])
            moved = replace(
                camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation + 1e-6 * mode[3:, k]
            )
            np.testing.assert_allclose(moved.project(world)[0], camera.project(x)[0], atol=1e-6)


def test_alignment_undoes_a_motion_and_a_scaling_of_the_world():
    Q, t = np.asarray(cv2.Rodrigues(np.array([0.02, -0.05, 0.1]))[0]), np.array([0.1, -0.2, 0.05])
    moved = []
    for camera in RIG:
        rotation = camera.rotation @ Q.T
        moved.append(replace(camera, rotation=rotation, translation=-rotation @ (1.02 * Q @ camera.center + t)))
    back = aligned(Rig(tuple(moved)), RIG, 0.002, 0.005)
    np.testing.assert_allclose(back.centers, RIG.centers, atol=1e-5)
    assert max(turn_between(one, other) for one, other in zip(back, RIG, strict=True)) < 1e-3


def test_body_family_begins_at_the_body():
    change = np.random.default_rng(4).normal(0, 0.01, (len(BODY.shape_groups), SHAPE_NUMBERS))
    body = BODY.reshaped(change)
    ellipsoid = [group_of(p.name) for p in BODY.parts if p.kind != CONE]
    change[[BODY.shape_groups.index(name) for name in ellipsoid], 2] = 0.0  # nothing tapers there
    np.testing.assert_allclose(shapes_of(body), change, atol=2e-4)
    family = BodyFamily.around(body)
    again = family.build(family.start)
    for one, other in zip(again.parts, body.parts, strict=True):
        np.testing.assert_allclose(one.shape, other.shape, rtol=2e-3)
        np.testing.assert_allclose(one.T_body_part, other.T_body_part, atol=3e-4)


# --- refinement ----------------------------------------------------------------------------------------------------


def test_refinement_corrects_perturbed_cameras():
    # rendered contours are exact, so the prior is wide
    how = RefinementSettings(trust=5.0, offsets=False)
    found = refine_cameras([(BODY, frames(in_time(), PERTURBED))], PERTURBED, how)
    (was_turned, was_moved), (turned, moved) = errors(PERTURBED), errors(found.rig)
    assert turned < 0.08 and turned < was_turned / 2.5, (was_turned, turned)
    assert moved < 0.006 and moved < was_moved, (was_moved, moved)
    assert (found.after_px < found.before_px).all()
    assert found.observed.all()


def test_true_cameras_hardly_move():
    found = refine_cameras([(BODY, frames(in_time(), RIG))], RIG, QUICK)
    assert found.turn_deg.max() < 0.05 and found.move_m.max() < 0.004
    # the gauge: the cameras have no common motion or scaling
    weight = np.tile(np.repeat([1 / np.radians(TURN_DEG), 1 / MOVE_M], 3), len(RIG))
    change = np.concatenate(
        [
            np.concatenate([cv2.Rodrigues(n.rotation @ o.rotation.T)[0].ravel(), -n.rotation @ (n.center - o.center)])
            for n, o in zip(found.rig, RIG, strict=True)
        ]
    )
    common = (world_motions(found.rig) * weight[:, None]).T @ (change * weight)
    assert np.abs(common).max() < 1e-2 * np.abs(change * weight).max() * weight.max()


def test_focal_lengths_are_refined():
    longer = np.diag([1.01, 1.01, 1.0])
    wide = Rig(
        tuple(
            replace(c, matrix=np.where(np.eye(3) > 0, c.matrix @ longer, c.matrix)) if c.name == "c2" else c
            for c in RIG
        )
    )
    found = refine_cameras([(BODY, frames(in_time(), wide))], wide, RefinementSettings(focal=True))
    assert found.focal[2] < 0.997 and np.abs(np.delete(found.focal, 2) - 1).max() < 0.004, found.focal


@pytest.mark.parametrize("late", [(0, 0, 1, 0), (0, 0.4, 0, 0)])
def test_delays_of_videos_are_estimated(late):
    store = rendered(late)
    done = refine_rig([tracked(store)], RIG, QUICK)
    assert done is not None
    np.testing.assert_allclose(done.offset_frames, late, atol=0.12)
    assert (done.offset_sigma_frames < 0.2).all()


def test_a_refinement_that_begins_at_another_finds_the_same_cameras():
    """The first one has found a video that is late by a frame; the second one has its other frames."""
    store, late = rendered((0, 0, 1, 0)), np.array([0, 0, 1, 0])
    first = refine_cameras([(BODY, frames(store, RIG))], RIG, QUICK)
    moved = bundle_frames(tracked(store), Views(RIG), FRAMES, SCALES, True, late)
    fresh, again = (refine_cameras([(BODY, moved)], RIG, QUICK, *begun) for begun in ((), (first, late)))
    np.testing.assert_allclose(again.offset_frames, fresh.offset_frames, atol=0.02)
    assert max(turn_between(a, b) for a, b in zip(again.rig, fresh.rig, strict=True)) < 0.01
    assert np.abs(again.rig.centers - fresh.rig.centers).max() < 0.001
    np.testing.assert_array_equal(again.before_px, fresh.before_px)


def test_too_few_usable_frames_give_none():
    assert refine_rig([tracked(in_time(), usable=slice(3, 8))], RIG, QUICK) is None


def test_agreement_names_the_inconsistent_and_the_late_camera():
    fine = camera_agreement([(BODY, frames(in_time(), RIG))], RIG)
    assert not fine.inconsistent.any() and not fine.late.any()
    one = Rig(tuple(disturbed(c, np.random.default_rng(5), 0.5, 0.0) if c.name == "c1" else c for c in RIG))
    found = camera_agreement([(BODY, frames(in_time(), one))], one)
    assert found.inconsistent[1] and np.linalg.norm(found.shift_px, axis=1).argmax() == 1
    late = camera_agreement([(BODY, frames(rendered((0, 0, 0, 1)), RIG))], RIG)
    assert late.late.tolist() == [False, False, False, True]


@pytest.mark.parametrize("turned_deg", [-3.0, 0.0, 3.0])
def test_two_cameras_of_which_one_is_turned_sideways_contradict_each_other(turned_deg: float):
    """The tracked person stands where the rays of both cameras meet, so only the person's size is wrong."""
    rig = Rig(tuple(RIG)[:2])
    wrong = turned(rig, 1, turned_deg)
    place = BODY.skeleton.joints(motion())[:, 0]
    pixels = [camera.project(place)[0] for camera in rig]
    rays = [camera.rays(seen) for camera, seen in zip(wrong, pixels, strict=True)]
    met = [closest_to_lines(wrong.centers, np.array(pair)) for pair in zip(*rays, strict=True)]
    poses = motion().copy()
    poses[:, [BODY.skeleton.names.index(f"torso_{axis}") for axis in "xyz"]] += np.array(met) - place
    seen = bundle_frames(tracked(in_time(), poses), Views(wrong), FRAMES, SCALES, True)
    contradiction = camera_agreement([(BODY, seen)], wrong).size_contradiction
    assert ("larger than" in contradiction) == (turned_deg != 0), contradiction


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError, match="trust = 0"):
        RefinementSettings(trust=0.0)


def test_chosen_frames_cover_all_positions_of_a_person_who_stands_still_for_long():
    standing, walking = np.zeros((500, 15, 3)), np.linspace(0, 1, 5)[:, None, None] * np.ones((15, 3))
    chosen = farthest(np.concatenate([standing, walking]), 5)
    assert np.count_nonzero(chosen >= 500) == 4
    assert len(farthest(standing, 5)) == 1 and len(farthest(standing[:0], 5)) == 0


def test_cameras_are_refined_from_all_people():
    """The equations of the cameras are the sum of those of each person, and their prior counts once."""
    seen = frames(in_time(), PERTURBED)
    people = [(BODY, seen[:4]), (build_cone_body(BodyDimensions.from_stature(1.6)), seen[4:])]
    sigmas = {"turn": 0.01, "move": 0.01}
    both, *alone = (PeopleBundle(some, PERTURBED, sigmas) for some in (people, people[:1], people[1:]))
    found, *parts = (bundle.linearise(bundle.start, 1).reduced() for bundle in (both, *alone))
    own = both.cameras
    prior = np.diag(np.tile(both.sigma**-2.0, len(RIG)))
    np.testing.assert_allclose(found.gradient[own], sum(part.gradient[own] for part in parts), rtol=1e-9)
    np.testing.assert_allclose(
        found.hessian[own, own], sum(part.hessian[own, own] for part in parts) - prior, rtol=1e-9, atol=1e-6
    )
    moved = both.move(both.start, np.zeros((len(seen), 200)), np.full(both.size, 0.01))
    assert all(turn_between(a, b) < 1e-9 for a, b in zip(moved[0].rig, moved[1].rig, strict=True))
    assert [len(state.poses) for state in moved] == [4, len(seen) - 4]
