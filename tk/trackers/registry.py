"""The trackers by the names of ``--method``. A new tracker is a class, named in METHODS, its state in TrackerState."""

from __future__ import annotations

from tk.errors import ConfigError
from tk.trackers.protocol import Tracker
from tk.trackers.region import RegionState, RegionTracker
from tk.trackers.silhouette import SilhouetteState, SilhouetteTracker
from tk.trackers.volumetric import VolumetricState, VolumetricTracker

METHODS: dict[str, type[Tracker]] = {
    kind.method: kind for kind in (RegionTracker, SilhouetteTracker, VolumetricTracker)
}


TrackerState = RegionState | SilhouetteState | VolumetricState


def tracker_class(method: str) -> type[Tracker]:
    """Return the tracker of this name.

    Raises:
        ConfigError: there is no method of this name.
    """
    if method not in METHODS:
        raise ConfigError(f"method {method}: choose one of {', '.join(METHODS)}")
    return METHODS[method]
