"""The generator of synthetic captures, at a tiny size, and the capture that ships with the package."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from scripts.make_capture import main
from scripts.synthetic.actor import Look, make_actor
from scripts.synthetic.capture import BACKGROUND_FRAMES, OFFSETS, CameraRenderer, Options, Plan, plan_capture
from scripts.synthetic.motion import HOLD, KNEE_RADIUS, MOTIONS
from scripts.synthetic.render import Body, distances, render_actor, sample_rays
from scripts.synthetic.rig import RIGS
from scripts.synthetic.skeleton import JOINTS, LIMITS_DEG, Pose, forward, make_skeleton, sole_points
from scripts.synthetic.tracing import CLOSE_M
from tk.io.toml import load_toml
from tk.model.cameras.camera import Camera

DEMO = Path(__file__).resolve().parents[2] / "tk" / "data" / "demo"
DEMO_BYTES = 5_000_000
BONES = [
    ("shoulder", "elbow", 0.186), ("elbow", "wrist", 0.146), ("hip", "knee", 0.245), ("knee", "ankle", 0.246),
]  # fmt: skip

TINY = Options(frames=2, cameras=4, size=(80, 60), seed=3)


@pytest.fixture(scope="module")
def tiny() -> Plan:
    return plan_capture(TINY)


@cache
def plan_of(motion: str) -> Plan:
    return plan_capture(Options(motion=motion, size=(80, 60)))


@pytest.fixture(params=list(MOTIONS))
def plan(request: pytest.FixtureRequest) -> Plan:
    return plan_of(request.param)


def joint(plan: Plan, name: str) -> np.ndarray:
    return plan.subject.joints[:, JOINTS.index(name)]


def test_bone_lengths_are_constant_and_follow_the_table(plan: Plan) -> None:
    for side in ("_l", "_r"):
        for a, b, ratio in BONES:
            length = np.linalg.norm(joint(plan, a + side) - joint(plan, b + side), axis=1)
            np.testing.assert_allclose(length, ratio * plan.options.stature_m, rtol=1e-9)
    np.testing.assert_allclose(joint(plan, "pelvis"), (joint(plan, "hip_l") + joint(plan, "hip_r")) / 2, atol=1e-12)


def test_rest_pose_has_the_stature_and_left_is_left() -> None:
    skeleton = make_skeleton(1.80)
    pose = forward(skeleton, {"yaw": np.zeros(1)})
    crown = pose.origin[0, skeleton.index("crown"), 2]
    sole = sole_points(skeleton, pose)[0, ..., 2].min()
    assert crown - sole == pytest.approx(1.80 + 0.012, abs=2e-3)  # 12 mm of rubber
    assert pose.origin[0, skeleton.index("hip_l"), 1] > 0 > pose.origin[0, skeleton.index("hip_r"), 1]
    assert pose.origin[0, skeleton.index("toes_l"), 0] > 0  # facing +x


def test_joints_bend_the_right_way() -> None:
    skeleton = make_skeleton()
    for side, s in (("_l", 1), ("_r", -1)):
        angle = {name: np.array([0.5]) for name in (f"elbow{side}", f"knee{side}", f"hip_abd{side}")}
        pose = forward(skeleton, angle)
        at = {name: pose.origin[0, skeleton.index(name + side)] for name in ("elbow", "wrist", "hip", "knee", "ankle")}
        assert at["wrist"][0] > at["elbow"][0] + 0.05  # elbows flex forwards
        assert at["ankle"][0] < at["knee"][0] - 0.05  # knees flex backwards
        assert s * (at["knee"][1] - at["hip"][1]) > 0.05  # abduction leads outwards


def test_motions_respect_joint_limits(plan: Plan) -> None:
    for name, values in plan.subject.motion.angles(np.arange(0, plan.frame_count, 0.25)).items():
        low, high = LIMITS_DEG[name]
        assert np.degrees(values).min() >= low - 1e-9, name
        assert np.degrees(values).max() <= high + 1e-9, name


def test_motions_start_in_the_da_vinci_pose(plan: Plan) -> None:
    for side in ("_l", "_r"):
        arm = (joint(plan, "wrist" + side) - joint(plan, "shoulder" + side))[:HOLD]
        assert np.degrees(np.abs(np.arcsin(arm[:, 2] / np.linalg.norm(arm, axis=1)))).max() < 10
        leg = (joint(plan, "ankle" + side) - joint(plan, "hip" + side))[:HOLD]
        spread = np.degrees(np.arctan2(np.abs(leg[:, 1]), -leg[:, 2]))
        assert 14 < spread.min() <= spread.max() < 21


def test_feet_stand_on_the_floor_and_do_not_slide(plan: Plan) -> None:
    soles = sole_points(plan.subject.skeleton, plan.subject.poses)  # (F, 2, 3, 3)
    lowest = soles[..., 2].min(axis=(1, 2))
    assert np.abs(lowest).max() < 0.015
    flat = soles[:, :, :, 2].max(axis=2) < 0.012  # (F, 2) feet that stand with the whole sole
    planted = flat[1:] & flat[:-1]
    slide = np.linalg.norm(np.diff(soles[:, :, 1, :2], axis=0), axis=2)
    assert np.median(slide[planted]) < 0.01


@pytest.mark.parametrize("name", ["object", "turn"])
def test_another_rate_shows_the_same_motion_at_the_same_times(name: str) -> None:
    motion = MOTIONS[name](make_skeleton(1.75))
    faster = motion.at_rate(4 * motion.fps)
    frames = np.arange(0.0, motion.frames, 7.0)
    assert (faster.frames, faster.fps) == (4 * motion.frames, 4 * motion.fps)
    for angle, values in motion.angles(frames).items():
        np.testing.assert_allclose(faster.angles(4 * frames)[angle], values, atol=1e-9)
    assert [faster.held_by(4 * int(f)) for f in frames] == [motion.held_by(int(f)) for f in frames]
    if motion.root is not None and faster.root is not None:
        np.testing.assert_allclose(faster.root(4 * frames), motion.root(frames))


def test_hands_and_elbows_stay_out_of_the_trunk_and_the_legs(plan: Plan) -> None:
    body = next(iter(plan.subject.bodies.values()))
    actor, names = body.actor, plan.subject.skeleton.names
    core = {"pelvis", "lumbar", "thorax", "chest", "head", "hip_l", "hip_r", "knee_l", "knee_r"}
    keep = np.array([names[bone] in core for bone in actor.bones])
    trunk = Body.of(
        replace(
            actor, bones=actor.bones[keep], material=actor.material[keep], shape=actor.shape[keep],
            centers=actor.centers[keep], radii=actor.radii[keep],
        ),
        Look().colors(), False,
    )  # fmt: skip
    bones = [names.index(name + side) for name in ("elbow", "wrist", "knuckles") for side in ("_l", "_r")]
    for frame in range(0, plan.frame_count, 3):
        pose = plan.subject.poses[frame : frame + 1]
        assert distances(trunk, pose, pose.origin[0, bones]).min() > -0.01, frame


def test_paper_sequences_contain_their_motions() -> None:
    def degrees(name: str) -> dict[str, np.ndarray]:
        motion = MOTIONS[name](make_skeleton())
        return {k: np.degrees(v) for k, v in motion.angles(np.arange(motion.frames)).items()}

    assert 25 < np.abs(np.diff(degrees("fast")["shoulder_flex_r"])).max() <= 31  # Kehl 2006, section 7.4
    cube = MOTIONS["object"](make_skeleton())
    assert {cube.held_by(frame) for frame in range(cube.frames)} == {"_l", "_r"}
    assert degrees("kick")["hip_flex_r"].max() > 70
    assert degrees("kick")["hip_flex_l"].max() > 70
    pedal = plan_of("pedal")
    apart = (joint(pedal, "wrist_l") - joint(pedal, "wrist_r"))[30:90]
    turns = np.unwrap(np.arctan2(apart[:, 2], apart[:, 0]))
    assert abs(turns[-1] - turns[0]) > 2 * 2 * np.pi


def test_turn_is_a_full_turn_with_stepping_feet() -> None:
    plan = plan_of("turn")
    across = (joint(plan, "hip_l") - joint(plan, "hip_r"))[:, :2]
    heading = np.degrees(np.unwrap(np.arctan2(across[:, 1], across[:, 0])))
    assert heading[-1] - heading[0] == pytest.approx(360, abs=1)
    turning = (np.abs(heading - heading[0]) > 4) & (np.abs(heading - heading[-1]) > 4)
    assert turning.sum() / plan.subject.motion.fps < 3
    tips = sole_points(plan.subject.skeleton, plan.subject.poses)[:, :, 2]
    assert tips[..., 2].max(axis=0).min() > 0.03
    on_floor = (tips[1:, :, 2] < 0.003) & (tips[:-1, :, 2] < 0.003)
    assert np.linalg.norm(np.diff(tips[..., :2], axis=0), axis=2)[on_floor].max() < 0.005
    for side in range(2):  # up and down, five times at least, the steps out of the Da Vinci pose not counted
        assert (np.diff((tips[30:, side, 2] > 0.03).astype(int)) == 1).sum() >= 5
    feet = np.stack(
        [plan.subject.poses.rotation[:, plan.subject.skeleton.index("ankle" + side), :2, 0] for side in ("_l", "_r")], 1
    )
    pointing = np.degrees(np.arctan2(feet[..., 1], feet[..., 0])) - (heading - 90)[:, None]
    assert np.abs((pointing + 180) % 360 - 180).max() < 45  # hips turn no further
    elbows = np.degrees([plan.subject.motion.angles(np.arange(30.0, 120))["elbow" + side] for side in ("_l", "_r")])
    assert (elbows.max(axis=1) > 70).all()
    assert (elbows.min(axis=1) < 45).all()


def test_crouch_goes_over_one_knee_to_the_heels_and_up_again() -> None:
    plan = plan_of("crouch")
    h = plan.options.stature_m
    clear = np.stack([joint(plan, "knee" + side)[:, 2] for side in ("_l", "_r")], axis=1) - KNEE_RADIUS * h
    assert clear.min() > -0.003
    kneels = clear < 0.003
    assert ((kneels.sum(axis=1) == 1) & (clear.max(axis=1) > 0.3)).sum() > 5  # on one knee, the other one up
    assert kneels.all(axis=1).sum() > 15
    low = joint(plan, "pelvis")[:, 2] / h
    squat = ~kneels.any(axis=1) & (low < 0.26)
    assert squat.any()
    hands = (joint(plan, "wrist_l") + joint(plan, "wrist_r")) / 2 - joint(plan, "neck")
    assert hands[squat, 0].min() > 0.2
    heels = sole_points(plan.subject.skeleton, plan.subject.poses)[:, :, 0]
    apart = np.linalg.norm(np.stack([joint(plan, "hip_l"), joint(plan, "hip_r")], axis=1) - heels, axis=2)
    sits = kneels.all(axis=1) & (apart.max(axis=1) < 0.15 * h)
    assert sits.sum() > 5
    assert low[0] - low[-1] < 0.02
    assert np.flatnonzero(squat)[0] < np.flatnonzero(kneels.any(axis=1))[0] < np.flatnonzero(sits)[0]


@pytest.mark.parametrize(("name", "stature"), [("turn", 2.0), ("crouch", 1.5)])
def test_legs_reach_their_steps_at_every_stature(name: str, stature: float) -> None:
    plan = plan_capture(Options(motion=name, size=(80, 60), stature_m=stature))
    lowest = sole_points(plan.subject.skeleton, plan.subject.poses)[..., 2].min(axis=(1, 2))
    assert np.abs(lowest).max() < 1e-3
    knees = [plan.subject.skeleton.index("knee" + side) for side in ("_l", "_r")]
    assert plan.subject.poses.origin[:, knees, 2].min() > KNEE_RADIUS * stature - 0.004


def oracle_distance(actor_body: Body, pose: Any, points: np.ndarray) -> np.ndarray:
    """Distance to the union of the cones, one by one by dense sampling of the family of spheres; no blending."""
    actor, best = actor_body.actor, np.full(len(points), np.inf)
    for i in range(len(actor.bones)):
        rotation, origin = pose.rotation[0, actor.bones[i]], pose.origin[0, actor.bones[i]]
        q = (points - origin) @ rotation
        row = actor.shape[i]
        h = np.linspace(0, 1, 400)[:, None]
        centers, radii = row[0:3] + h * (row[4:7] - row[0:3]), row[3] + h[:, 0] * (row[7] - row[3])
        d = (np.linalg.norm(q[:, None] / row[8:11] - centers, axis=2) - radii).min(axis=1)
        cut = row[11:14] @ q.T - row[14]
        best = np.minimum(best, np.maximum(d * row[8:11].min(), -cut))
    return best


def test_distance_kernel_agrees_with_a_plain_union(tiny: Plan) -> None:
    """Unblended, unwrinkled, unsqueezed, the kernel's distance is the union's; far off it is a lower bound."""
    actor = make_actor(make_skeleton())
    shape = actor.shape.copy()
    shape[:, 15:17], shape[:, 8:11] = 0.0, 1.0
    shape[:, 11:15] = (0, 0, 1, -9)
    radii = np.maximum(shape[:, 3], shape[:, 7]) + np.linalg.norm(shape[:, 4:7] - shape[:, 0:3], axis=1) / 2
    centers = (shape[:, 0:3] + shape[:, 4:7]) / 2
    plain = Body.of(replace(actor, shape=shape, radii=radii, centers=centers), Look().colors(), False)
    pose = tiny.subject.poses[:1]
    rng = np.random.default_rng(0)
    joints = tiny.subject.joints[0]
    points = joints[rng.integers(0, len(joints), 300)] + rng.normal(0, 0.15, (300, 3))
    expected, found = oracle_distance(plain, pose, points), distances(plain, pose, points)
    near = found < CLOSE_M
    assert near.sum() > 50
    np.testing.assert_allclose(found[near], expected[near], atol=2e-4)  # the oracle samples 400 spheres a cone
    assert (found <= expected + 2e-4).all()


def test_traced_beams_find_the_same_body_as_dense_samples_of_each_ray(tiny: Plan) -> None:
    """At rest, the coverage is the share of a pixel's rays that have a point inside the body."""
    camera, body, pose = tiny.rig[0], tiny.subject.body(0), tiny.subject.poses[:1]
    rays = sample_rays(camera, OFFSETS)
    still = Pose(pose.rotation.repeat(4, axis=0), pose.origin.repeat(4, axis=0))
    found = render_actor(camera, rays, body, still, tiny.lamps, tiny.shadow(0))[::4, ::4, 3]
    rays = rays[:, ::4, ::4]  # every fourth row and column, to save time
    clear = np.full(rays.shape[:3], np.inf)
    for depth in np.linalg.norm(pose.origin[0, 0] - camera.center) + np.arange(-1.0, 1.0, 0.02):
        points = camera.center + depth * rays.reshape(-1, 3)
        clear = np.minimum(clear, distances(body, pose, points).reshape(clear.shape))
    # the points of a ray are 2 cm apart: the body may be nearer between them
    assert (found[(clear < 0).all(axis=0)] == 1).all()
    assert (found[(clear > 0.01).all(axis=0)] == 0).all()
    assert np.abs(found - (clear < 0.001).mean(axis=0)).mean() < 0.002


def test_render_shows_the_actor_where_the_truth_is(tiny: Plan) -> None:
    for index in range(2):
        renderer = CameraRenderer(tiny, index)
        picture = renderer.frame(1)
        pixels, _ = tiny.rig[index].project(tiny.subject.joints[1])
        x, y = np.rint(pixels).astype(int).T
        grown = cv2.dilate(picture.mask, np.ones((3, 3), np.uint8))
        assert (grown[y, x] == 255).all()
        share = (picture.mask > 0).mean()
        assert 0.01 < share < 0.25
        border = np.concatenate([picture.mask[[0, -1]].ravel(), picture.mask[:, [0, -1]].ravel()])
        assert not border.any()
        empty = next(iter(renderer.background())).astype(float)
        change = np.abs(picture.image.astype(float) - empty).mean(axis=2)
        assert change[picture.mask > 0].mean() > 4 * change[picture.mask == 0].mean()


def test_materials_are_where_they_belong(tiny: Plan) -> None:
    """The red shirt is at the chest and the blue trousers at the knees."""
    renderer = CameraRenderer(tiny, 0)
    image = renderer.frame(0).image.astype(int)
    camera: Camera = tiny.rig[0]
    chest = (tiny.subject.joints[0, JOINTS.index("neck")] * 0.7 + tiny.subject.joints[0, 0] * 0.3)[None]
    x, y = np.rint(camera.project(chest)[0][0]).astype(int)
    assert image[y, x, 0] > 1.5 * image[y, x, 2]
    x, y = np.rint(camera.project(joint(tiny, "knee_l")[:1])[0][0]).astype(int)
    assert image[y, x, 2] > 1.2 * image[y, x, 0]


@pytest.mark.parametrize("count", RIGS)
def test_every_rig_sees_all_of_the_volume_that_matters(count: int) -> None:
    plan = plan_capture(Options(cameras=count, size=(160, 120)))
    assert len(plan.rig) == count
    body = plan.subject.body(0)
    centers, radii = body.actor.balls(plan.subject.poses)
    for camera in plan.rig:
        pixels, _ = camera.project(centers.reshape(-1, 3))
        assert camera.sees(centers.reshape(-1, 3)).all(), camera.name
        assert np.isfinite(pixels).all()
    lower, upper = plan.volume.lower, plan.volume.upper
    reach = np.tile(radii, len(centers))[:, None]
    assert (centers.reshape(-1, 3) - reach)[:, :2].min(axis=0) == pytest.approx(lower[:2] + 0.175, abs=0.03)
    assert (centers.reshape(-1, 3) + reach).max(axis=0) == pytest.approx(upper - 0.175, abs=0.03)


def test_command_writes_a_capture_and_is_deterministic(tmp_path: Path) -> None:
    arguments = ["--frames", "2", "--size", "80x60", "--cameras", "4", "--seed", "5", "--masks", "--shirt", "#2060c0"]
    contents = []
    for name in ("a/x", "b/x"):
        result = CliRunner().invoke(main, ["--out", str(tmp_path / name), *arguments])
        assert result.exit_code == 0, result.output
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        contents.append({path.relative_to(tmp_path / name): path.read_bytes() for path in files})
    assert len(contents[0]) == 3 + 4 + 4 + 8
    assert contents[0] == contents[1]


def test_command_refuses_odd_sizes(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["--out", str(tmp_path), "--size", "81x60"])
    assert result.exit_code == 2
    assert "even" in result.output


def test_shipped_capture_is_small_and_agrees_with_itself() -> None:
    files = [path for path in DEMO.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= DEMO_BYTES
    calibration = load_toml(DEMO / "calibration.toml")
    settings = load_toml(DEMO / "capture.toml")
    names = [name for name in calibration if name != "metadata"]
    with h5py.File(DEMO / "truth.h5") as truth:
        position, frames = truth["joints/position"][:], truth["frames"][:]
        assert tuple(truth["joints/position"].attrs["names"]) == JOINTS
        np.testing.assert_allclose(truth["time"][:], frames / settings["fps"])
    assert position.shape == (len(frames), len(JOINTS), 3)
    for name in names:
        table = calibration[name]
        for kind, count in (("videos", len(frames)), ("background", BACKGROUND_FRAMES)):
            with av.open(str(DEMO / kind / f"{name}.mp4")) as container:
                stream = container.streams.video[0]
                assert (stream.width, stream.height) == tuple(table["size"])
                assert float(stream.average_rate) == settings["fps"]
                assert sum(1 for _ in container.decode(stream)) == count
        rotation = cv2.Rodrigues(np.array(table["rotation"]))[0]
        camera = Camera(
            name, *table["size"], np.array(table["matrix"]), np.array(table["distortions"]), rotation,
            np.array(table["translation"]),
        )  # fmt: skip
        assert camera.sees(position.reshape(-1, 3)).all()
    lower = np.array(settings["volume"]["center"]) - np.array(settings["volume"]["size"]) / 2
    upper = lower + np.array(settings["volume"]["size"])
    assert (position > lower).all()
    assert (position < upper).all()


def test_shipped_truth_is_what_the_generator_makes() -> None:
    plan = plan_capture(Options(seed=7))
    with h5py.File(DEMO / "truth.h5") as truth:
        np.testing.assert_allclose(truth["joints/position"][:], plan.subject.joints, atol=1e-6)
