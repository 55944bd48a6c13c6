"""The trackers by the names of ``--method``. A new tracker is a class with the protocol, and its name in METHODS."""

from __future__ import annotations

from tk.errors import ConfigError
from tk.trackers.protocol import Tracker
from tk.trackers.region import RegionTracker
from tk.trackers.silhouette import SilhouetteTracker
from tk.trackers.volumetric import VolumetricTracker

METHODS: dict[str, type[Tracker]] = {
    kind.method: kind for kind in (RegionTracker, SilhouetteTracker, VolumetricTracker)
}


def tracker_class(method: str) -> type[Tracker]:
    """Return the tracker of this name.

    Raises:
        ConfigError: there is no method of this name.
    """
    if method not in METHODS:
        raise ConfigError(f"method {method}: choose one of {', '.join(METHODS)}")
    return METHODS[method]
