"""The table of datasets: the docs state it, and a written file follows it."""

from __future__ import annotations

from pathlib import Path

import h5py

from tests.io.result_files import make_cameras, make_smoothed, revise_result, write
from tests.io.result_victim import META
from tk.io.results.schema import SCHEMA, Dataset, columns_of

ROOT = Path(__file__).parents[3]


def docs_row(entry: Dataset) -> str:
    """Return a row of the table in the docs."""
    attributes = ", ".join(f"`{name}`" for name in entry.attributes)
    meaning = f"{entry.meaning}; {attributes}" if attributes else entry.meaning
    return f"| `/{entry.path}` | {'×'.join(entry.shape.split())} {entry.dtype} | {meaning} |"


def test_docs_list_every_dataset_of_the_schema() -> None:
    lines = (ROOT / "docs" / "result-file.md").read_text(encoding="utf-8").splitlines()
    missing = [entry.path for entry in SCHEMA if docs_row(entry) not in lines]
    assert not missing
    groups = ("smoothed/…", "model/…", "people/<n>/…")
    listed = [line.split("`")[1] for line in lines if line.startswith("| `/")]
    assert sorted(listed) == sorted(f"/{path}" for path in (*(entry.path for entry in SCHEMA), *groups))


def test_every_dataset_of_a_file_is_in_the_schema(path: Path) -> None:
    write(path, 3)
    revise_result(path, smoothed=make_smoothed(3), cameras=make_cameras(), model={"height_m": 1.7})
    known = {*columns_of(META), *(entry.path for entry in SCHEMA)}
    found: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    found = [name.removeprefix("people/0/") for name in found]
    free = ("model/", "resume")
    assert {name.removeprefix("smoothed/") for name in found if not name.startswith(free)} - known == {"bridged"}
    families = {entry.path for entry in SCHEMA if "<" in entry.path}
    assert {entry.path for entry in SCHEMA} - families <= set(found)
