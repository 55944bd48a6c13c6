"""Damaged and malicious HDF5 files are read, or refused in one line that names the file; nothing hangs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.io.result_files import append, make_cameras, make_smoothed, resume, revise_result, write_truth
from tests.io.result_victim import META
from tk.errors import ResultError, TkError
from tk.evaluation.joints import evaluate
from tk.io.hdf5 import MAX_DEPTH, open_hdf5
from tk.io.results.data import JointTrack
from tk.io.results.reader import read_joints, read_result
from tk.io.results.writer import ResultWriter
from tk.model.body.skeleton import JOINTS

COUNT = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `result.h5`, which has all that a result can have, and `truth.h5`."""
    folder = tmp_path_factory.mktemp("hdf5")
    with ResultWriter.create(folder / "result.h5", META) as writer:
        writer.write_model({"torso/radii_m": np.arange(4.0), "height_m": 1.78, "sex": "any", "count": 3})
        append(writer, *range(COUNT))
    revise_result(folder / "result.h5", smoothed=make_smoothed(COUNT), cameras=make_cameras())
    write_truth(folder / "truth.h5", list(range(3, 3 + COUNT)))
    return folder


@pytest.fixture
def result(folder: Path, tmp_path: Path) -> Path:
    """Return a copy of the result, to be damaged."""
    return Path(shutil.copy(folder / "result.h5", tmp_path))


@pytest.fixture
def truth(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(folder / "truth.h5", tmp_path))


read_once = cache(read_joints)


def read(path: Path) -> None:
    """Read a file; an error is one line that names it."""
    _refused_in_one_line(path, lambda: read_result(path))


def _refused_in_one_line(path: Path, way: Callable[[], object]) -> None:
    try:
        way()
    except TkError as error:
        assert path.name in str(error) and "\n" not in str(error)


def read_in_every_way(path: Path, folder: Path) -> None:
    """Read a file with all readers, and compare it with whole files."""
    tracks: list[JointTrack] = []
    ways: list[Callable[[], object]] = [
        lambda: read_result(path),
        lambda: tracks.append(read_joints(path)),
        lambda: [evaluate(track, read_once(folder / "truth.h5")) for track in tracks],
        lambda: [evaluate(read_once(folder / "result.h5"), track) for track in tracks],
        lambda: resume(path, COUNT + 1),
    ]
    for way in ways:
        _refused_in_one_line(path, way)


# --- any damage -------------------------------------------------------------------------------------------------------

# where in the file, as a share, and what is put there
patches = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.one_of(
            st.binary(min_size=1, max_size=8),
            st.sampled_from([b"\x00" * 8, b"\xff" * 8, b"\xff" * 64, b"\x00" * 512, (2**40).to_bytes(8, "little")]),
        ),
    ),
    min_size=0,
    max_size=4,
)
flips = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 7)), max_size=8)


def near_structure(data: bytes, share: float) -> int:
    """Return a place in the file; every second one is near a signature of HDF5's own structures."""
    at = int(share * len(data))
    if int(share * 1e6) % 2:
        return at
    found = [data.find(mark, at) for mark in (b"TREE", b"SNOD", b"HEAP", b"GCOL")]
    return min([place + int(share * 1e9) % 96 for place in found if place >= 0] or [at]) % len(data)


# the same examples each time: a new one may find a new way to hang HDF5 itself, which is a task, not a broken build
@settings(max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(["result.h5", "truth.h5"]),
    patched=patches,
    flipped=flips,
    kept=st.one_of(st.just(1.0), st.just(1.0), st.floats(0, 1)),
)
def test_changed_and_missing_bytes_give_one_line(
    folder: Path,
    tmp_path: Path,
    name: str,
    patched: list[tuple[float, bytes]],
    flipped: list[tuple[float, int]],
    kept: float,
) -> None:
    whole = (folder / name).read_bytes()
    data = bytearray(whole)
    for share, patch in patched:
        at = near_structure(whole, share)
        data[at : at + len(patch)] = patch[: len(data) - at]
    for share, bit in flipped:
        data[near_structure(whole, share)] ^= 1 << bit
    path = tmp_path / "damaged.h5"
    path.write_bytes(data[: int(kept * len(data))])
    read_in_every_way(path, folder)


DATASETS = [
    "frames", "pose", "joints/position", "joints/sigma", "status", "timing/total", "angles/hip_l", "cameras/size",
    "smoothed/bridged", "hull/offsets", "hull/positions", "model/height_m", "resume",
]  # fmt: skip
VALUES = [
    np.float64(1e300), np.full((COUNT, 24), np.inf), np.full(COUNT, -1), np.full((COUNT, 15, 3), 1e300), "text",
    np.arange(COUNT, dtype=np.uint64) + 2**63, np.full(COUNT, 2.5), np.zeros(COUNT, dtype=[("a", "f8"), ("b", "i4")]),
    np.zeros((0, 3)), np.full((COUNT, 15), -1.0), np.zeros(COUNT, complex),
]  # fmt: skip


@pytest.mark.parametrize("name", DATASETS)
def test_datasets_of_another_type_give_one_line(result: Path, folder: Path, name: str) -> None:
    good = result.read_bytes()
    for value in VALUES:
        result.write_bytes(good)
        with h5py.File(result, "r+") as file:
            del file[name]
            file[name] = value
        read(result)
    result.write_bytes(good)
    with h5py.File(result, "r+") as file:
        del file[name]
        file.create_group(name)
    read_in_every_way(result, folder)


@pytest.mark.parametrize("holder", ["/", "pose", "joints/position", "timing", "angles", "cameras", "iterations"])
def test_other_attributes_give_one_line(result: Path, folder: Path, holder: str) -> None:
    good = result.read_bytes()
    with h5py.File(result) as file:
        names = list(file[holder].attrs)
    values = [
        np.nan, "two\nlines\x1b", np.bytes_(b"caf\xe9"), ["a", "b"], np.zeros((2, 2)), h5py.Empty("f8"),
    ]  # fmt: skip
    for name in names:
        for value in values:
            result.write_bytes(good)
            with h5py.File(result, "r+") as file:
                file[holder].attrs[name] = value
            read(result)
        result.write_bytes(good)
        with h5py.File(result, "r+") as file:
            del file[holder].attrs[name]
        read_in_every_way(result, folder)


# --- malicious files --------------------------------------------------------------------------------------------------


def soft_link(file: h5py.File, folder: Path) -> None:
    file["joints/position"] = h5py.SoftLink("/nowhere")


def ring_of_links(file: h5py.File, folder: Path) -> None:
    file["joints/position"] = h5py.SoftLink("/joints/position")


def external_link(file: h5py.File, folder: Path) -> None:
    file["joints/position"] = h5py.ExternalLink(str(folder / "truth.h5"), "joints/position")


def external_storage(file: h5py.File, folder: Path) -> None:
    file.create_dataset("joints/position", (COUNT, 15, 3), "f8", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def virtual(file: h5py.File, folder: Path) -> None:
    layout = h5py.VirtualLayout((COUNT, 15, 3), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "truth.h5"), "joints/position", (COUNT, 15, 3))
    file.create_virtual_dataset("joints/position", layout)


def huge(file: h5py.File, folder: Path) -> None:
    file.create_dataset("joints/position", (10**12, 15, 3), "f8", chunks=(64, 15, 3))


def huge_chunks(file: h5py.File, folder: Path) -> None:
    file.create_dataset("joints/position", (COUNT, 15, 3), "f8", chunks=(10**7, 15, 3), maxshape=(None, 15, 3))


def bomb(file: h5py.File, folder: Path) -> None:
    file.create_dataset("joints/position", data=np.zeros((20_000, 15, 3)), chunks=(20_000, 15, 3), compression=9)


def strange_filter(file: h5py.File, folder: Path) -> None:
    file.create_dataset("joints/position", data=np.zeros((COUNT, 15, 3), "i4"), chunks=(COUNT, 15, 3), scaleoffset=0)


def ring_of_groups(file: h5py.File, folder: Path) -> None:
    file["joints/again"] = file["/"]


def deep(file: h5py.File, folder: Path) -> None:
    file.create_group("/".join(["deeper"] * (MAX_DEPTH + 2)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (soft_link, "is a link"),
        (ring_of_links, "is a link"),
        (external_link, "is a link"),
        (external_storage, "is stored in another file"),
        (virtual, "is stored in another file"),
        (huge, "declares 360000000000000 bytes"),
        (huge_chunks, "bytes, and 0 are stored"),
        (bomb, "bytes, and .* are stored"),
        (strange_filter, "a compression that tk cannot read"),
        (ring_of_groups, "deep"),
        (deep, "deep"),
    ],
)
def test_links_external_data_and_oversized_data_are_refused(
    truth: Path, folder: Path, make: Callable[[h5py.File, Path], None], message: str
) -> None:
    with h5py.File(truth, "r+") as file:
        if make not in (ring_of_groups, deep):
            del file["joints/position"]
        make(file, folder)
    for reader in (read_joints, read_result):
        with pytest.raises(ResultError, match=rf"truth\.h5: .*{message}"):
            reader(truth)


def test_compressed_dataset_is_read(truth: Path) -> None:
    values = np.random.default_rng(0).normal(size=(COUNT, 15, 3))
    with h5py.File(truth, "r+") as file:
        del file["joints/position"]
        file.create_dataset("joints/position", data=values, compression="gzip", shuffle=True, fletcher32=True)
        file["joints/position"].attrs["names"] = list(JOINTS)
    np.testing.assert_array_equal(read_joints(truth).positions, values)


def test_file_that_this_process_holds_open_is_read(truth: Path) -> None:
    with h5py.File(truth) as held:  # as in a notebook
        np.testing.assert_array_equal(read_joints(truth).positions, held["joints/position"][:])


def test_integers_and_single_precision_are_converted(truth: Path) -> None:
    values = np.random.default_rng(0).integers(-2, 3, (COUNT, 15, 3))
    for frames, dtype in ((np.arange(COUNT, dtype=np.float64), np.int32), (np.arange(COUNT, dtype="u1"), np.float32)):
        with h5py.File(truth, "r+") as file:
            for name in ("frames", "joints/position"):
                del file[name]
            file["frames"], file["joints/position"] = frames, values.astype(dtype)
            file["joints/position"].attrs["names"] = list(JOINTS)
        track = read_joints(truth)
        assert (track.frames.dtype, track.positions.dtype) == (np.int64, np.float64)
        np.testing.assert_array_equal(track.positions, values)


def test_heap_of_texts_that_would_hang_hdf5_is_refused(truth: Path) -> None:
    data = bytearray(truth.read_bytes())
    heap = data.index(b"GCOL")
    data[heap + 16 : heap + 32] = bytes(16)  # free space of size zero: HDF5 2.0.0 loops in it forever
    truth.write_bytes(data)
    with pytest.raises(ResultError, match="heap"):
        read_joints(truth)


def test_pipes_devices_and_dangling_links_are_refused(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.h5"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero")):
        with pytest.raises(ResultError, match="is not a file"):
            read_joints(path)
    dangling = tmp_path / "link.h5"
    dangling.symlink_to(tmp_path / "nowhere.h5")
    with pytest.raises(ResultError, match="link to nowhere"):
        read_joints(dangling)


def test_reader_lists_datasets_and_groups(result: Path) -> None:
    with open_hdf5(result) as file:
        assert file.shapes["people/0/joints/position"] == (COUNT, 15, 3)
        assert "people/0/model" in file and "people/0/model/height_m" in file and "nothing" not in file
        assert "model" not in file, "a link"
        assert file.below("people/0/model") == ["count", "height_m", "sex", "torso/radii_m"]
        with pytest.raises(ResultError, match=r"/pose has shape 6×24; any×3 is expected"):
            file.array("people/0/pose", "float64", (None, 3))
        with pytest.raises(ResultError, match="out of range"):
            file.array("people/0/pose", "float64", (COUNT, 24), high=1.0)
