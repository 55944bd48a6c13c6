"""The tables of the silhouette paper at a small size."""

import pytest

from scripts import silhouette_tables
from tests.conftest import development_capture


@pytest.mark.slow
def test_a_few_frames_of_the_treadmill_make_a_row_and_a_figure(tmp_path):
    data = silhouette_tables.load(development_capture("treadmill-slow"), ("cam3", "cam6", "cam1", "cam4"), 6)
    assert data.rig.names == ("cam3", "cam6", "cam1", "cam4")
    name, views, config = silhouette_tables.variants()[-2]
    row, joints = silhouette_tables.track(data, name, views, config)
    assert (row.name, row.views, row.swaps) == ("tk", 3, 0)
    # the paper's figures are 17.6 % and 2 % of the subject's height
    assert 0 < row.error_share < 17.5 and 0 < row.ankle_share < 2.0
    assert row.joints_cm < 6.0 and joints.shape == (6, 15, 3)
    assert "| tk | 3 | 3 × 3 |" in silhouette_tables.table([row])
    silhouette_tables.draw_figure(data, joints, tmp_path / "figure6.png")
    assert (tmp_path / "figure6.png").stat().st_size > 1000
