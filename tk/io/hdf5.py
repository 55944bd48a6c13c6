"""Open and read HDF5 files from any source, damaged files included.

All objects of the file are checked before any data are read: groups and datasets must be in the file itself, without
links and external storage, and declare no more data than the file can hold. Data are returned only with the requested
type and shape. HDF5 and h5py raise many kinds of exceptions for a damaged file; all of them become a
:class:`~tk.errors.ResultError` of one line.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np
from h5py import h5z
from numpy.typing import NDArray

from tk.errors import ResultError, TkError
from tk.io.paths import text_of

#: limits of groups and datasets in a file, nested groups, bytes of an attribute: far more than a result has
MAX_OBJECTS, MAX_DEPTH, MAX_ATTRIBUTE_BYTES = 10_000, 12, 1_000_000

#: filters that only compress or check
FILTERS = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_LZF)

#: limits of the compression ratio, and of the declared bytes of a dataset without stored data (HDF5 does not store
#: chunks that were never written)
MAX_COMPRESSION, MAX_UNWRITTEN_BYTES = 100, 65_536

_FIRST = b"/people/0/"  # where the links of a result lead

_HEAP = b"GCOL\x01\x00\x00\x00"  # start of a heap of texts: signature, version, reserved

_NUMBERS = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM)  # h5py stores bool as an enumeration
_KINDS = {"f": "fiu", "i": "iuf", "u": "iuf", "b": "biu"}  # stored kinds that are accepted for a requested kind


class Hdf5Reader:
    """An open file whose objects have been checked. Make one with :func:`open_hdf5`.

    Attributes:
        path: the file.
        shapes: shape of every dataset, by its name without a leading slash.
        groups: names of all groups.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.groups: set[str] = {""}
        self._file = file
        # objects that are open: to find one by its name takes as long as to read it
        self._datasets: dict[str, h5py.h5d.DatasetID] = {}
        self._holders: dict[str, h5py.AttributeManager] = {}
        self._bytes = path.stat().st_size
        with self._guarded("/"):
            _check_text_heaps(path, file)
            self._survey()

    def __contains__(self, name: str) -> bool:
        return name in self.shapes or name in self.groups

    def fail(self, message: str) -> NoReturn:
        """Raise a ResultError about this file, as one line even if the message quotes several."""
        raise self._error(message)

    def _error(self, message: str) -> ResultError:
        line = "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))
        return ResultError(f"{self.path}: {line if len(line) <= 400 else f'{line[:400]}...'}")

    def below(self, group: str) -> list[str]:
        """Return the names of the datasets below a group, relative to it, sorted."""
        return sorted(name[len(group) + 1 :] for name in self.shapes if name.startswith(f"{group}/"))

    def array(
        self,
        name: str,
        dtype: str,
        shape: tuple[int | None, ...],
        low: float = -math.inf,
        high: float = math.inf,
        finite: bool = False,
    ) -> NDArray[Any]:
        """Return a dataset of numbers.

        Args:
            name: name of the dataset.
            dtype: numpy's name of the requested type.
            shape: requested shape; None stands for any length.
            low, high: range of valid numbers. Infinity is read as NaN unless the range contains it.
            finite: refuse NaN and infinity.

        Raises:
            ResultError: the dataset is missing, has another shape, or numbers that do not fit the type or the range.
        """
        if name not in self.shapes:
            self.fail(f"has no /{name}; the file is damaged")
        found, wanted = self.shapes[name], np.dtype(dtype)
        if len(found) != len(shape) or any(b is not None and a != b for a, b in zip(found, shape, strict=True)):
            expected = "×".join("any" if length is None else str(length) for length in shape) or "one number"
            self.fail(f"/{name} has shape {'×'.join(map(str, found)) or 'one number'}; {expected} is expected")
        values = self._numbers(name)
        if values.dtype.kind not in _KINDS[wanted.kind]:
            self.fail(f"/{name} holds {values.dtype}; {wanted} is expected")
        known = values[np.isfinite(values)]
        if wanted.kind in "iu":
            if (known != np.round(known)).any():
                self.fail(f"/{name} holds numbers that are not whole")
            low, high = max(float(np.iinfo(wanted).min), low), min(float(np.iinfo(wanted).max), high)
        elif wanted.kind == "b":
            low, high = 0.0, 1.0
        if len(known) < values.size and (finite or wanted.kind in "iu"):
            self.fail(f"/{name} holds NaN or infinity; the file is damaged")
        outside = known[(known < low) | (known > high)]
        if len(outside):
            self.fail(f"/{name} holds {outside[0]:g}, which is out of range; the file is damaged")
        if len(known) < values.size and high < math.inf:
            values = np.where(np.isinf(values), np.asarray(np.nan, values.dtype), values)
        return values.astype(wanted)

    def values(self, group: str, limit: float) -> dict[str, Any]:
        """Return all datasets below a group as a flat mapping of texts, numbers and arrays; {} if there is no group.

        Raises:
            ResultError: a dataset holds neither numbers nor text, or a number of a magnitude above ``limit``.
        """
        if group in self.shapes:
            self.fail(f"/{group} is a dataset, not a group; the file is damaged")
        found: dict[str, Any] = {}
        for name in self.below(group):
            path = f"{group}/{name}"
            with self._guarded(path):
                dataset = h5py.Dataset(self._datasets[path])
                is_text = dataset.id.get_type().get_class() == h5py.h5t.STRING
                value = dataset[()] if is_text else self._numbers(path)[()]
                found[name] = value.decode() if isinstance(value, bytes) else value
            numbers = np.asarray(value)
            if numbers.dtype.kind == "f" and (np.abs(numbers[np.isfinite(numbers)]) > limit).any():
                self.fail(f"/{path} holds a number that is out of range; the file is damaged")
        return found

    def attribute(self, holder: str, name: str) -> Any:
        """Return an attribute of a dataset or group: texts, numbers, or arrays of them; None if it does not exist."""
        with self._guarded(f"{holder}, attribute {name},"):
            if holder not in self._holders:
                self._holders[holder] = self._file[f"/{holder}"].attrs
            attributes = self._holders[holder]
            if name not in attributes:
                return None
            found = attributes.get_id(name)
            size = math.prod(found.shape) * found.get_type().get_size()
            if found.get_type().get_class() not in (*_NUMBERS, h5py.h5t.STRING) or size > MAX_ATTRIBUTE_BYTES:
                self.fail(f"the attribute {name} of /{holder} is neither text nor numbers; the file is damaged")
            value = attributes[name]
            return text_of(value) if isinstance(value, (bytes, str)) else value

    def is_format(self, name: str) -> bool:
        """Return True if the attribute `format` of the file has this value."""
        found = self.attribute("", "format")
        return isinstance(found, str) and found == name

    def text(self, holder: str, name: str, default: str | None = None) -> str:
        """Return an attribute that is one text."""
        value = self.attribute(holder, name)
        if value is None and default is not None:
            return default
        if not isinstance(value, str):
            self._no_attribute(holder, name, "a text")
        return value

    def number(self, holder: str, name: str) -> float:
        """Return an attribute that is one finite number."""
        value = self.attribute(holder, name)
        if np.ndim(value) or not isinstance(value, (int, float, np.integer, np.floating)) or not math.isfinite(value):
            self._no_attribute(holder, name, "a number")
        return float(value)

    def names(self, holder: str, name: str) -> tuple[str, ...]:
        """Return an attribute that is a list of texts."""
        value = self.attribute(holder, name)
        listed = [text_of(item) if isinstance(item, (bytes, str)) else item for item in np.atleast_1d(value)]
        if value is None or np.ndim(value) > 1 or not all(isinstance(item, str) for item in listed):
            self._no_attribute(holder, name, "a list of texts")
        return tuple(str(item) for item in listed)

    def _no_attribute(self, holder: str, name: str, expected: str) -> NoReturn:
        self.fail(f"/{holder} has no attribute {name} that is {expected}; the file is damaged")

    def _numbers(self, name: str) -> NDArray[Any]:
        """Return a dataset of numbers. Each NaN becomes numpy's NaN, because other NaN bits cause warnings later."""
        with self._guarded(name):
            stored = self._datasets[name]
            kind = stored.dtype.kind if stored.get_type().get_class() in _NUMBERS else "?"
            if kind not in "fiub" or stored.dtype.itemsize > 8:
                self.fail(f"/{name} does not hold numbers; the file is damaged")
            values = np.empty(stored.shape, stored.dtype)
            if values.size:
                stored.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
            return np.where(np.isnan(values), np.asarray(np.nan, values.dtype), values) if kind == "f" else values

    @contextlib.contextmanager
    def _guarded(self, name: str) -> Iterator[None]:
        try:
            with np.errstate(all="ignore"):
                yield
        except TkError:
            raise
        except Exception as error:
            what = f"/{name} cannot be read; the file is damaged" if name != "/" else "is damaged"
            raise self._error(what) from error

    def _survey(self) -> None:
        waiting: list[tuple[str, int]] = [("", 0)]
        while waiting:
            name, depth = waiting.pop()
            if depth > MAX_DEPTH:
                self.fail(f"/{name}: groups are nested more than {MAX_DEPTH} deep; the file is damaged")
            group = h5py.h5g.open(self._file.id, f"/{name}".encode())
            for link in self._links(group, name):
                path = f"{name}/{link}" if name else link
                kind = h5py.h5o.get_info(group, link.encode()).type
                if kind == h5py.h5o.TYPE_GROUP:
                    self.groups.add(path)
                    waiting.append((path, depth + 1))
                elif kind == h5py.h5o.TYPE_DATASET:
                    dataset = self._datasets[path] = h5py.h5d.open(group, link.encode())
                    self.shapes[path] = self._check_storage(path, dataset)
                if len(self.shapes) + len(self.groups) > MAX_OBJECTS:
                    self.fail(f"holds more than {MAX_OBJECTS} groups and datasets; the file is damaged")

    def _links(self, group: h5py.h5g.GroupID, name: str) -> list[str]:
        """Return the names in a group. Links of the top level to person 0 are ignored, others refused."""
        found: list[tuple[bytes, int]] = []

        def take(link: bytes, info: h5py.h5l.LinkInfo) -> bool | None:  # HDF5 does not pass on its exceptions
            found.append((link, info.type))
            return True if len(found) > MAX_OBJECTS else None

        group.links.iterate(take, info=True)
        if len(found) > MAX_OBJECTS:
            self.fail(f"holds more than {MAX_OBJECTS} groups and datasets; the file is damaged")
        for link, kind in found:
            own = kind == h5py.h5l.TYPE_SOFT and not name and group.links.get_val(link) == _FIRST + link
            if kind != h5py.h5l.TYPE_HARD and not own:
                path = f"/{name}/{link.decode()}".replace("//", "/")
                self.fail(f"{path} is a link; replace it by a copy of the data")
        return [link.decode() for link, kind in found if kind == h5py.h5l.TYPE_HARD]

    def _check_storage(self, name: str, dataset: h5py.h5d.DatasetID) -> tuple[int, ...]:
        """Return the shape of a dataset; refuse external data and more data than the file can hold."""
        made = dataset.get_create_plist()
        layout = made.get_layout()
        if layout not in (h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED) or made.get_external_count():
            self.fail(f"/{name} is stored in another file; copy it into this one")
        shape = tuple(int(length) for length in dataset.shape)
        item = int(dataset.get_type().get_size())
        stored = int(dataset.get_storage_size())
        filters = [made.get_filter(index)[0] for index in range(made.get_nfilters())]
        if any(code not in FILTERS for code in filters):
            self.fail(f"/{name} has a compression that tk cannot read; write it with gzip or uncompressed")
        limit = max(stored * (MAX_COMPRESSION if filters else 1), MAX_UNWRITTEN_BYTES)
        declared = item * math.prod(shape)
        if layout == h5py.h5d.CHUNKED and declared:
            declared = max(declared, item * math.prod(made.get_chunk()))
        if stored > self._bytes or declared > limit:
            self.fail(f"/{name} declares {declared} bytes, and {stored} are stored; the file is damaged")
        return shape


def _check_text_heaps(path: Path, file: h5py.File) -> None:
    """Check the heaps that hold texts of variable length.

    HDF5 (up to 2.0.0) loops forever in a heap with an object of size zero. Source of the layout: section III.E of the
    HDF5 file format specification.

    Raises:
        ResultError: a heap is damaged.
    """
    if file.id.get_create_plist().get_sizes() != (8, 8):
        raise ResultError(f"{path}: its addresses do not have 8 bytes; write it again with another HDF5")
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = data.find(_HEAP)
        while start >= 0:
            if len(data) - start >= 16:
                (size,) = struct.unpack_from("<Q", data, start + 8)
                end = start + min(size, len(data) - start)
                at = start + 16
                while end - at >= 16:
                    index, length = struct.unpack_from("<H6xQ", data, at)
                    taken = 16 + (length + 7) // 8 * 8 if index else length  # object 0 is the free space
                    if not 0 < taken <= end - at:
                        raise ResultError(f"{path}: the heap of its texts is damaged")
                    at += taken
            start = data.find(_HEAP, start + 1)


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5Reader]:
    """Open a file for reading and check its objects. No lock is needed: a published result is never modified.

    Raises:
        ResultError: the file does not exist, is not HDF5, or is damaged.
    """
    if not path.is_file():
        if path.exists():
            raise ResultError(f"{path}: {'is a folder; name a file' if path.is_dir() else 'is not a file'}")
        raise ResultError(f"{path}: {'is a link to nowhere' if path.is_symlink() else 'no such file'}")
    try:
        try:
            file = h5py.File(path, "r", locking=False)
        except OSError:  # HDF5 also refuses if this process has the file open with locks, h5py's default
            file = h5py.File(path, "r")
    except PermissionError:
        raise ResultError(f"{path}: no permission to read it") from None
    except Exception as error:  # a damaged file raises exceptions of almost any type
        raise ResultError(f"{path}: is not an HDF5 file, or is damaged") from error
    with file:
        yield Hdf5Reader(path, file)
