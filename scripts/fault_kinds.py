"""The faults of `scripts/faults.py`: each one spoils a copy of a capture.

:data:`FAULTS` lists them by name. Most spoil one camera (:attr:`Faulty.camera`); names with "all" spoil every camera.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from scripts.faulty import Faulty, Image, Video
from tk.io.toml import load_toml
from tk.model.cameras.camera import Camera

TURN_DEG = 2.0  # rotation of the faulty camera
MORE_DEG = 3.0  # rotation of the faulty cameras where too few correct ones are left to contradict them
FAR_DEG = 10.0  # rotation that excludes a camera
CUT = 40  # frames missing at a cut
LATE = 3  # frames
FLIPPED_BYTES = 400
ZOOM = 1.2  # factor of a camera's focal length
SHIFT_PX = 15  # of masks
DRIFT = 0.03  # share by which a camera's clock is slow: 4 frames after 120
OTHER_TIME = 25  # frames by which masks belong to another time


# --- videos -----------------------------------------------------------------------------------------------------------


def each(edit: Callable[[Image], Image]) -> Callable[[Video], Video]:
    """Return a function that edits every image of a video."""
    return lambda video: [np.ascontiguousarray(edit(image)) for image in video]


def scaled(image: Image, gain: float) -> Image:
    return np.asarray((image * gain).round().clip(0, 255), np.uint8)


def zoomed(image: Image, factor: float) -> Image:
    """Return the image as a camera with a longer lens shows it."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
    return np.asarray(cv2.warpAffine(image, matrix, (width, height)), np.uint8)


def turned_image(camera: Camera, image: Image, angle_deg: float) -> Image:
    """Return the image of the camera after it was turned about its upright axis."""
    T = cv2.Rodrigues(np.radians([0.0, angle_deg, 0.0]))[0]
    warp = camera.matrix @ T @ np.linalg.inv(camera.matrix)
    return np.asarray(cv2.warpPerspective(image, warp, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE), np.uint8)


def black(faulty: Faulty) -> None:
    faulty.change(lambda video: [p if i < faulty.begin else np.zeros_like(p) for i, p in enumerate(video)])


def frozen(faulty: Faulty) -> None:
    faulty.change(lambda video: [video[min(i, faulty.begin)] for i in range(len(video))])


def swapped_videos(faulty: Faulty) -> None:
    """Swap the videos of two cameras."""
    one, other = faulty.video(faulty.camera), faulty.video(faulty.next)
    between = one.with_name("between" + one.suffix)
    one.rename(between)
    other.rename(one)
    between.rename(other)


def swapped_cameras(faulty: Faulty) -> None:
    """Swap the videos of two cameras, and their empty scenes."""
    plate = {faulty.camera: faulty.plate(faulty.next), faulty.next: faulty.plate(faulty.camera)}
    give_background(faulty, lambda c: plate.get(c, faulty.plate(c)))
    swapped_videos(faulty)


def exchanged_videos(faulty: Faulty) -> None:
    """Give each camera the video of the next one."""
    paths = [faulty.video(c) for c in faulty.all]
    for c, path in enumerate(paths):
        path.rename(path.with_name(f"moved-{c}"))
    for c, path in enumerate(paths):
        path.with_name(f"moved-{(c + 1) % len(paths)}").rename(path)


def same_video(faulty: Faulty) -> None:
    """Give the camera a copy of the next one's video."""
    faulty.video(faulty.camera).unlink()
    shutil.copy(faulty.video(faulty.next), faulty.video(faulty.camera))


def cut(faulty: Faulty) -> None:
    """Remove frames from all videos, so that the person jumps."""
    faulty.cut = CUT
    faulty.change(lambda video: video[: faulty.begin] + video[faulty.begin + CUT :], faulty.all)


def other_rate(faulty: Faulty) -> None:
    """Record one camera at twice the rate of the others."""
    faulty.change(lambda video: [image for image in video for _ in range(2)], faster=2)


def bump(faulty: Faulty, angle_deg: float) -> None:
    """Turn the camera in the middle of the recording."""
    camera = faulty.original.rig[faulty.camera]
    faulty.change(
        lambda video: [p if i < faulty.begin else turned_image(camera, p, angle_deg) for i, p in enumerate(video)]
    )


def sagging(faulty: Faulty) -> None:
    """Turn the camera slowly, by :data:`MORE_DEG` in the end."""
    camera = faulty.original.rig[faulty.camera]
    faulty.change(lambda v: [turned_image(camera, p, MORE_DEG * i / (len(v) - 1)) for i, p in enumerate(v)])


def camera_excluded(faulty: Faulty) -> None:
    """Use three cameras and turn one so far that it must be excluded."""
    bump(faulty, FAR_DEG)
    names = faulty.original.rig.names
    faulty.used = tuple(names[(faulty.camera + i) % len(names)] for i in (-1, 0, 1))


def truncated(faulty: Faulty) -> None:
    """Truncate the video file."""
    path = faulty.video(faulty.camera)
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: 2 * len(data) // 3])


def flipped(faulty: Faulty) -> None:
    """Damage bytes in the middle of a video's images."""
    path = faulty.video(faulty.camera)
    data = bytearray(path.read_bytes())
    path.unlink()
    start = data.find(b"mdat") + 4
    middle = len(data) // 3, 2 * len(data) // 3
    rng = np.random.default_rng(0)
    for position in rng.integers(max(start, middle[0]), middle[1], FLIPPED_BYTES):
        data[position] ^= int(rng.integers(1, 256))
    path.write_bytes(bytes(data))


def dropped(faulty: Faulty) -> None:
    """Drop five frames of one video, which becomes shorter."""
    gone = faulty.begin + np.array([0, 4, 5, 12, 20])
    faulty.change(lambda video: [p for i, p in enumerate(video) if i not in gone])


def repeated(faulty: Faulty) -> None:
    """Repeat the frame before a tenth of the frames of each camera, as a recorder does that loses frames."""
    rng = np.random.default_rng(0)
    faulty.change(lambda video: [video[max(i - int(rng.random() < 0.1), 0)] for i in range(len(video))], faulty.all)


def slow_clock(faulty: Faulty) -> None:
    """Let the camera's clock be slow: the delay grows."""
    faulty.change(lambda video: [video[round(i * (1 - DRIFT))] for i in range(len(video))])


def variable_rate(faulty: Faulty) -> None:
    """Drop frames of the camera at random; the time stamps of its video are true."""
    rng = np.random.default_rng(0)
    kept = [i for i in range(faulty.count) if i in (0, faulty.count - 1) or rng.random() < 0.9]
    faulty.write(faulty.video(faulty.camera), [faulty.images(faulty.camera)[i] for i in kept], times=kept)


def away(faulty: Faulty, frames: Callable[[int], bool]) -> None:
    """Show the empty scene in all views in some frames."""
    for camera in faulty.all:
        plate = faulty.plate(camera)
        images = [plate if frames(i) else p for i, p in enumerate(faulty.images(camera))]
        faulty.write(faulty.video(camera), images)


def bystander(faulty: Faulty) -> None:
    """Add a second person to two of the views, cut out of the same recording at another time."""
    masks = faulty.masks()
    for camera in (faulty.camera, (faulty.camera + 2) % len(faulty.all)):
        video = faulty.images(camera)
        result = []
        for i, image in enumerate(video):
            image = image.copy()
            if i >= faulty.begin:
                j = (i + len(video) // 2) % len(video)
                columns = [np.flatnonzero((masks[k][camera] >= 128).any(axis=0)) for k in (i, j)]
                width = image.shape[1]
                # on the side of the person with more room
                middle = [float(c.mean()) if len(c) else width / 2 for c in columns]
                aim = middle[0] + width * (0.3 if middle[0] < width / 2 else -0.3)
                shift = round(aim - middle[1])
                where = np.roll(masks[j][camera][: image.shape[0], :width] >= 128, shift, 1)
                image[where] = np.roll(video[j], shift, 1)[where]
            result.append(image)
        faulty.write(faulty.video(camera), result)


def chair_moved(faulty: Faulty) -> None:
    """Put an object into the pictures of two cameras, beside the person, that the empty scene does not have."""

    def with_object(video: Video) -> Video:
        for image in video[faulty.begin :]:
            height, width = image.shape[:2]
            image[height // 2 : height * 4 // 5, width * 5 // 8 : width * 3 // 4] = (40, 60, 90)
        return video

    faulty.change(with_object, (faulty.camera, faulty.next))


def clock_in_picture(faulty: Faulty) -> None:
    """Write the time into a corner of all pictures, as webcams do."""

    def with_clock(video: Video) -> Video:
        for i, image in enumerate(video):
            text = f"2024-05-01 12:00:{i / faulty.original.fps:06.3f}"
            cv2.putText(image, text, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 2, cv2.LINE_AA)
        return video

    faulty.change(with_clock, faulty.all)


def letterboxed(image: Image) -> Image:
    """Return the image squeezed to three quarters of its height between black bars."""
    height, width = image.shape[:2]
    inner = 3 * height // 4
    bar = (height - inner) // 2
    small = cv2.resize(image, (width, inner), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.copyMakeBorder(small, bar, height - inner - bar, 0, 0, cv2.BORDER_CONSTANT), np.uint8)


def long_exposure(video: Video) -> Video:
    """Return a video whose images are means of three."""
    at = [[max(i - 1, 0), i, min(i + 1, len(video) - 1)] for i in range(len(video))]
    return [np.asarray(np.mean([video[k] for k in three], axis=0).round(), np.uint8) for three in at]


def flicker(faulty: Faulty) -> None:
    """Change the exposure of all cameras from frame to frame by up to 30 %."""
    rng = np.random.default_rng(0)
    faulty.change(each(lambda image: scaled(image, rng.uniform(0.7, 1.0))), faulty.all)


def noise(faulty: Faulty) -> None:
    rng = np.random.default_rng(0)
    faulty.change(each(lambda p: (p + rng.normal(0, 25, p.shape)).clip(0, 255).astype(np.uint8)), faulty.all)


def light_from(faulty: Faulty, gain: float) -> None:
    """Dim all pictures from :attr:`Faulty.begin` on."""
    faulty.change(lambda video: [p if i < faulty.begin else scaled(p, gain) for i, p in enumerate(video)], faulty.all)


# --- calibration and description --------------------------------------------------------------------------------------


def turn(faulty: Faulty, angles_deg: dict[int, float]) -> None:
    """Rotate cameras in the calibration, by index, each about its own upright axis."""

    def turned(c: int, camera: Camera) -> Camera:
        T = cv2.Rodrigues(np.radians([0.0, angles_deg.get(c, 0.0), 0.0]))[0]
        return replace(camera, rotation=T @ camera.rotation, translation=T @ camera.translation)

    faulty.calibrate(turned)


def two_turned(faulty: Faulty) -> None:
    """Rotate two cameras in the calibration, in opposite directions."""
    turn(faulty, {faulty.camera: MORE_DEG, (faulty.camera + 2) % len(faulty.all): -MORE_DEG})


def one_of_two_turned(faulty: Faulty) -> None:
    """Use two cameras and rotate one of them in the calibration."""
    turn(faulty, {faulty.camera: MORE_DEG})
    names = faulty.original.rig.names
    faulty.used = names[faulty.camera - 1], names[faulty.camera]


def facing_cameras(faulty: Faulty) -> None:
    """Use two cameras that face each other."""
    axes = np.array([camera.rotation[2] for camera in faulty.original.rig])
    first, second = np.unravel_index(int(np.argmin(axes @ axes.T)), (len(axes), len(axes)))
    names = faulty.original.rig.names
    faulty.used = names[first], names[second]


def foreign_calibration(faulty: Faulty) -> None:
    """Use the calibration of another capture."""
    if faulty.foreign is None:
        raise SystemExit(f"{faulty.original.path}: no capture beside it has as many cameras (give --foreign CAPTURE)")
    path = faulty.folder / "calibration.toml"
    path.unlink()
    shutil.copy(faulty.foreign / "calibration.toml", path)


def of(cameras: str, edit: Callable[[Camera], Camera]) -> Callable[[Faulty], None]:
    """Return a fault that edits the calibration of "one" camera or of "all"."""
    return lambda faulty: faulty.calibrate(lambda c, k: edit(k) if cameras == "all" or c == faulty.camera else k)


def longer_lens(camera: Camera) -> Camera:
    return replace(camera, matrix=camera.matrix * [[ZOOM, ZOOM, 1], [ZOOM, ZOOM, 1], [1, 1, 1]])


def of_other_size(camera: Camera) -> Camera:
    """Return the camera calibrated for pictures of twice the size."""
    return replace(camera, matrix=np.diag([2.0, 2.0, 1.0]) @ camera.matrix)


def distorted(camera: Camera) -> Camera:
    """Return the camera with a distortion that its lens has not, such as one of the wrong sign."""
    distortions = camera.distortions.copy()
    distortions[0] += 0.2
    return replace(camera, distortions=distortions)


def off_center(camera: Camera) -> Camera:
    """Return the camera with its principal point at the pictures' corner."""
    matrix = camera.matrix.copy()
    matrix[:2, 2] = 0
    return replace(camera, matrix=matrix)


def inverse(camera: Camera) -> Camera:
    """Return the camera with its pose in the world in place of the world in the camera's frame."""
    return replace(camera, rotation=camera.rotation.T, translation=camera.center)


def opengl(camera: Camera) -> Camera:
    """Return the camera with OpenGL's axes: y up, z backwards."""
    flip = np.diag([1.0, -1.0, -1.0])
    return replace(camera, rotation=flip @ camera.rotation, translation=flip @ camera.translation)


def in_unit(metres: float) -> Callable[[Camera], Camera]:
    """Return a function that writes translations in a unit that the file does not give."""
    return lambda camera: replace(camera, translation=camera.translation / metres)


def time_offset(seconds: float) -> Callable[[Faulty], None]:
    """Return a fault that gives the camera a delay that it has not."""

    def fault(faulty: Faulty) -> None:
        path = faulty.folder / "calibration.toml"
        tables = load_toml(path)
        tables[faulty.original.calibration.keys[faulty.camera]]["time_offset"] = seconds
        path.unlink()
        path.write_text(tomli_w.dumps(tables), encoding="utf-8")

    return fault


def volume_beside(faulty: Faulty, sides: float) -> None:
    """Move the working volume by a number of its lengths along x."""
    volume = faulty.original.volume
    center = [volume.center[0] + sides * volume.size[0], *volume.center[1:]]
    faulty.describe(volume={"center": center, "size": list(volume.size)})


# --- empty scene and masks --------------------------------------------------------------------------------------------


def give_background(faulty: Faulty, image: Callable[[int], Image]) -> None:
    """Replace the clips of the empty scene by still images, given a camera's index."""
    images = [image(c) for c in faulty.all]  # some are made from the clips
    shutil.rmtree(faulty.folder / "background", ignore_errors=True)
    (faulty.folder / "background").mkdir()
    for camera, own in zip(faulty.original.rig, images, strict=True):
        cv2.imwrite(str(faulty.folder / "background" / f"{camera.name}.png"), own)


def shifted(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.roll(masks, SHIFT_PX, axis=2)


def torn(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the masks (F, h, w) with ten round holes in each, of a fiftieth of the image's height."""
    rng = np.random.default_rng(0)
    masks = masks.copy()
    for mask in masks:
        for y, x in rng.permutation(np.argwhere(mask >= 128))[:10].tolist():
            cv2.circle(mask, (x, y), len(mask) // 50, 0, -1)
    return masks


def grown(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the masks (F, h, w) with a margin of a sixtieth of the image's height."""
    r = masks.shape[1] // 60
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1, 2 * r + 1))
    return np.array([cv2.dilate(mask, kernel) for mask in masks])


def legless(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the masks (F, h, w) without the lower half of the person."""
    masks = masks.copy()
    for mask in masks:
        rows = np.flatnonzero((mask >= 128).any(axis=1))
        if len(rows):
            mask[(rows[0] + rows[-1]) // 2 :] = 0
    return masks


def one_mask(edit: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Callable[[Faulty], None]:
    """Return a fault that edits the masks of one camera."""
    return lambda faulty: faulty.give_masks(lambda c, masks: edit(masks) if c == faulty.camera else masks)


def all_masks(edit: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Callable[[Faulty], None]:
    """Return a fault that edits the masks of all cameras."""
    return lambda faulty: faulty.give_masks(lambda _, masks: edit(masks))


def inverted(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.uint8(255) - masks


def later(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the masks of another time."""
    return np.roll(masks, OTHER_TIME, axis=0)


def mixed(faulty: Faulty) -> None:
    """Give the camera the masks of the next one."""
    masks = faulty.masks()
    faulty.give_masks(
        lambda c, own: masks[:, faulty.next, : own.shape[1], : own.shape[2]] if c == faulty.camera else own
    )


FAULTS: dict[str, Callable[[Faulty], None]] = {
    "none": lambda faulty: None,
    # a camera's video
    "black": black,
    "frozen": frozen,
    "bumped": lambda faulty: bump(faulty, TURN_DEG),
    "sagging": sagging,
    "short": lambda faulty: faulty.change(lambda video: video[: 2 * len(video) // 3]),
    "truncated": truncated,
    "flipped": flipped,
    "late": lambda faulty: faulty.change(lambda video: video[LATE:]),
    "dropped": dropped,
    "slow clock": slow_clock,
    "variable rate": variable_rate,
    "other rate": other_rate,
    "exposure": lambda faulty: faulty.change(
        lambda video: [scaled(p, 1.0 - 0.4 * i / (len(video) - 1)) for i, p in enumerate(video)]
    ),
    "mirrored": lambda faulty: faulty.change(each(lambda image: image[:, ::-1])),
    "upside down": lambda faulty: faulty.change(each(lambda image: image[::-1, ::-1])),
    "zoomed": lambda faulty: faulty.change(
        lambda video: [p if i < faulty.begin else zoomed(p, ZOOM) for i, p in enumerate(video)]
    ),
    "zooming": lambda faulty: faulty.change(
        lambda video: [zoomed(p, 1 + (ZOOM - 1) * i / (len(video) - 1)) for i, p in enumerate(video)]
    ),
    "letterboxed": lambda faulty: faulty.change(each(letterboxed)),
    "blurred": lambda faulty: faulty.change(each(lambda p: np.asarray(cv2.GaussianBlur(p, (0, 0), 6.0), np.uint8))),
    "same video": same_video,
    "swapped videos": swapped_videos,
    "swapped cameras": swapped_cameras,
    "camera excluded": camera_excluded,
    # all videos
    "cut": cut,
    "bystander": bystander,
    "chair moved": chair_moved,
    "away": lambda faulty: away(faulty, lambda i: faulty.begin <= i < faulty.begin + 10),
    "enters late": lambda faulty: away(faulty, lambda i: i < faulty.begin),
    "leaves early": lambda faulty: away(faulty, lambda i: i >= 2 * faulty.count // 3),
    "all exchanged": exchanged_videos,
    "all mirrored": lambda faulty: faulty.change(each(lambda image: image[:, ::-1]), faulty.all),
    "all repeat frames": repeated,
    "all blurred": lambda faulty: faulty.change(
        each(lambda p: np.asarray(cv2.GaussianBlur(p, (0, 0), 6.0), np.uint8)), faulty.all
    ),
    "all exposed long": lambda faulty: faulty.change(long_exposure, faulty.all),
    "all noisy": noise,
    "all flicker": flicker,
    "all show a clock": clock_in_picture,
    "lamp fails": lambda faulty: light_from(faulty, 0.5),
    "lights off": lambda faulty: light_from(faulty, 0.05),
    "one frame": lambda faulty: faulty.change(lambda video: video[:1], faulty.all),
    "three frames": lambda faulty: faulty.change(lambda video: video[:3], faulty.all),
    # calibration
    "turned": lambda faulty: turn(faulty, {faulty.camera: TURN_DEG}),
    "two turned": two_turned,
    "one of two turned": one_of_two_turned,
    "facing cameras": facing_cameras,
    "foreign calibration": foreign_calibration,
    "lens": of("one", longer_lens),
    "all lenses": of("all", longer_lens),
    "distortion": of("one", distorted),
    "all distortions": of("all", distorted),
    "all of other size": of("all", of_other_size),
    "all off center": of("all", off_center),
    "all inverse": of("all", inverse),
    "all of OpenGL": of("all", opengl),
    "all in mm": of("all", in_unit(0.001)),
    "all in cm": of("all", in_unit(0.01)),
    "unit mm": lambda faulty: faulty.calibrate(lambda _, camera: camera, units="mm"),
    "unit cm": lambda faulty: faulty.calibrate(lambda _, camera: camera, units="cm"),
    "offset of 0.2 s": time_offset(0.2),
    "offset of 5 s": time_offset(5.0),
    "offset of -5 s": time_offset(-5.0),
    "offset of 1e6 s": time_offset(1e6),
    # capture.toml
    "wrong fps": lambda faulty: faulty.describe(fps=2 * faulty.original.fps),
    "up is y": lambda faulty: faulty.describe(up="y"),
    "up is -z": lambda faulty: faulty.describe(up="-z"),
    "volume beside": lambda faulty: volume_beside(faulty, 1.0),
    "half a volume": lambda faulty: volume_beside(faulty, 0.5),
    "height of 1.2 m": lambda faulty: faulty.describe(subject={"height": 1.2}),
    "frame of another pose": lambda faulty: faulty.describe(init={"frame": 2 * faulty.count // 3}),
    # the empty scene
    "person in background": lambda faulty: give_background(faulty, lambda c: faulty.images(c)[0]),
    "backgrounds exchanged": lambda faulty: give_background(faulty, lambda c: faulty.plate((c + 1) % len(faulty.all))),
    "dark background": lambda faulty: give_background(faulty, lambda c: scaled(faulty.plate(c), 0.6)),
    # masks
    "mask shifted": one_mask(shifted),
    "masks shifted": all_masks(shifted),
    "mask inverted": one_mask(inverted),
    "masks inverted": all_masks(inverted),
    "mask of another time": one_mask(later),
    "masks of another time": all_masks(later),
    "mask of another camera": mixed,
    "masks with holes": all_masks(torn),
    "masks too large": all_masks(grown),
    "mask without legs": one_mask(legless),
    "masks without legs": all_masks(legless),
}
