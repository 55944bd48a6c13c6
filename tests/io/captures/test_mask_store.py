"""Masks are kept bit for bit, in little memory, and unpacked one at a time."""

import tempfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from tk.errors import TkError
from tk.io.captures.mask_store import MaskStore
from tk.kernels.mask_values import OTHERS
from tk.model.masks.silhouettes import Pyramid


@given(masks=array_shapes(min_dims=3, max_dims=3, max_side=13).flatmap(lambda s: arrays(np.uint8, s)))
@settings(max_examples=60)
def test_stored_masks_are_returned_as_0_255_and_other_people(masks):
    store = MaskStore()
    store.put(7, masks)
    found = store.get(7)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, np.where(masks >= 128, 255, np.where(masks == OTHERS, OTHERS, 0)))
    store.put(7, found)
    np.testing.assert_array_equal(store.get(7), found)


def test_a_store_without_cameras_shows_nobody_in_them():
    store, masks = MaskStore(), np.full((3, 4, 6), 255, np.uint8)
    masks[2, :2] = OTHERS
    store.put(5, masks)
    fewer = store.without(np.array([True, False, False]))
    assert not fewer.get(5)[0].any()
    np.testing.assert_array_equal(fewer.get(5)[1:], masks[1:])
    np.testing.assert_array_equal(store.get(5), masks)
    assert store.without(np.zeros(3, np.bool_)) is store


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_sequence_of_frames_has_the_requested_order(seed):
    rng = np.random.default_rng(seed)
    store, masks = MaskStore(), {}
    for index in rng.permutation(20)[:6].tolist():
        masks[index] = (rng.random((2, 5, 9)) < 0.5).astype(np.uint8) * 255
        store.put(index, masks[index])
    wanted = rng.permutation(list(masks))
    frames = store.sequence(wanted)
    assert len(frames) == 6 and all(i in store for i in masks) and 99 not in store
    for i, index in enumerate(wanted):
        np.testing.assert_array_equal(frames[i], masks[int(index)])
    for index, found in zip(wanted, frames, strict=True):
        np.testing.assert_array_equal(found, masks[int(index)])
    part = frames[1:5:2]
    assert len(part) == 2
    np.testing.assert_array_equal(part[1], masks[int(wanted[3])])
    np.testing.assert_array_equal(frames[-1], masks[int(wanted[-1])])
    with pytest.raises(IndexError):
        frames[6]


def test_masks_of_neighbouring_frames_are_joined_without_a_copy():
    rng, store, frames = np.random.default_rng(0), MaskStore(), 20
    masks = (rng.random((frames, 2, 5, 9)) < 0.5).astype(np.uint8) * 255
    for index in range(frames):
        store.put(index, masks[index])
    found = store.sequence(np.arange(frames))
    sizes = (np.array([[9, 5], [9, 5]], np.int32),)

    def joined(chosen):
        return Pyramid.of_all([Pyramid((found[i],), sizes) for i in chosen], 0).masks[0]

    first = found[0]
    for chosen in (range(16), range(3, 7), range(16, 20), range(12, 20), (1, 0), (4, 6), (2, 2)):
        whole = joined(chosen)
        np.testing.assert_array_equal(whole, masks[list(chosen)].reshape(-1, 5, 9))
    assert np.shares_memory(joined(range(16)), first) and not np.shares_memory(joined((0, 2)), first)
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0, 0] = 1


def test_a_frame_of_silhouettes_takes_less_than_ten_kilobytes(tmp_path):
    masks = np.zeros((5, 480, 640), np.uint8)
    masks[:, 100:400, 250:350] = 255
    store = MaskStore(tmp_path / "masks")
    for index in range(10):
        store.put(index, masks)
    assert (tmp_path / "masks").stat().st_size < 10 * 10_000


def test_a_frame_that_was_not_stored_is_a_key_error():
    with pytest.raises(KeyError):
        MaskStore().get(0)


def test_masks_beyond_the_memory_limit_go_to_an_unnamed_file(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    spooled = tempfile.SpooledTemporaryFile
    monkeypatch.setattr(tempfile, "SpooledTemporaryFile", lambda _: spooled(2000))
    rng = np.random.default_rng(0)
    masks = (rng.random((12, 2, 30, 40)) < 0.5).astype(np.uint8) * 255
    store = MaskStore()
    for index, frame in enumerate(masks):
        store.put(index, frame)
    assert store._opened._rolled, "on disk now"
    for index in (11, 0, 5):
        np.testing.assert_array_equal(store.get(index), masks[index])
    assert list(tmp_path.iterdir()) == [], "the file has no name"


def test_a_full_disk_is_reported_in_one_line(monkeypatch, tmp_path):
    def full(_):
        raise OSError(28, "No space left on device")

    store = MaskStore()
    store.put(0, np.zeros((1, 2, 2), np.uint8))
    monkeypatch.setattr(store._opened, "write", full)
    with pytest.raises(TkError, match="masks cannot be kept there: No space left"):
        store.put(1, np.zeros((1, 2, 2), np.uint8))
    assert 1 not in store
    with pytest.raises(TkError, match=r"nowhere.*masks cannot be kept there: No such"):
        MaskStore(tmp_path / "nowhere" / "masks").put(0, np.zeros((1, 2, 2), np.uint8))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_masks_of_a_killed_run_are_read_up_to_the_damage(seed, tmp_path_factory):
    """Whatever the damage, the masks that are read are right."""
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("run") / ".r.h5.masks"
    masks = (rng.random((6, 2, 7, 9)) < 0.5).astype(np.uint8) * 255
    colors = rng.integers(0, 1 << 16, (6, 2, 3, 4), np.uint16)
    store = MaskStore(path)
    assert not path.exists(), "the first put creates it"
    for index, frame in enumerate(masks):
        store.put(index, frame, colors[index] if index % 2 else None)
    whole = MaskStore(path, resume=True)
    for index, frame in enumerate(masks):
        np.testing.assert_array_equal(whole.get(index), frame)
        assert index % 2 or whole.colors(index) is None
    data = bytearray(path.read_bytes())
    kept = len(data) // 6 * int(rng.integers(0, 6)) + int(rng.integers(0, 30))
    path.write_bytes(bytes(data[:kept]) + rng.bytes(int(rng.integers(0, 40))))
    after = MaskStore(path, resume=True)
    found = [index for index in range(6) if index in after]
    assert found == list(range(len(found)))
    for index in found:
        np.testing.assert_array_equal(after.get(index), masks[index])
        if index % 2:
            np.testing.assert_array_equal(after.colors(index), colors[index])
    after.put(5, masks[5])
    np.testing.assert_array_equal(MaskStore(path, resume=True).get(5), masks[5])
    MaskStore(path).put(0, masks[0])
    assert 5 not in MaskStore(path, resume=True), "without resume the file is overwritten"


def test_masks_that_are_stored_again_show_nothing_of_the_earlier_ones(tmp_path):
    store = MaskStore(tmp_path / "masks")
    masks = np.zeros((1, 4, 6), np.uint8)
    masks[0, 1, :4] = 255, 255, OTHERS, OTHERS
    store.put(3, masks, np.ones((1, 2, 3), np.uint16))
    later = np.where(masks == OTHERS, 0, masks).astype(np.uint8)
    store.put(3, later)
    for known in (store, MaskStore(tmp_path / "masks", resume=True)):
        np.testing.assert_array_equal(known.get(3), later)
        assert known.colors(3) is None
    store.put(3, masks, np.ones((1, 2, 3), np.uint16))
    for known in (store, MaskStore(tmp_path / "masks", resume=True)):
        np.testing.assert_array_equal(known.get(3), masks)
        assert known.colors(3) is not None
