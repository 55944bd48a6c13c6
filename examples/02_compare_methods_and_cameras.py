"""Track the same frames in several ways, and print how far the joints are from the truth.

    python examples/02_compare_methods_and_cameras.py [CAPTURE] [--frames 45] [--config FILE]

Without CAPTURE it takes the one that ships with tk. CAPTURE must have a truth.h5.
"""

import argparse
from itertools import islice
from pathlib import Path

import numpy as np

import tk
from tk.io.results.reader import read_joints

DEMO = Path(tk.__file__).parent / "data" / "demo"
LIMBS = slice(3, 15)  # shoulders, elbows, wrists, hips, knees, ankles

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("capture", nargs="?", type=Path, default=DEMO)
parser.add_argument("--frames", type=int, default=45, help="how many, at most")
parser.add_argument("--config", type=Path, help="settings, TOML")
options = parser.parse_args()
config = tk.read_settings(options.config) if options.config else tk.Settings()

truth = read_joints(options.capture / "truth.h5")  # positions (F, 15, 3) metres
cameras = tk.open_capture(options.capture).rig.names
runs = {
    "region, all cameras": ("region", None),
    f"region, without {cameras[-1]}": ("region", cameras[:-1]),
    "region, three cameras": ("region", cameras[:3]),
    "silhouette, all cameras": ("silhouette", None),
}

print(f"{'':28}  mean [cm]  limbs [cm]  lost  E_S of the cameras")
for label, (method, chosen) in runs.items():
    capture = tk.open_capture(options.capture, chosen)
    # an iterator: nothing is written, and one may stop when one has seen enough
    estimates = list(islice(tk.track(capture, method=method, config=config), options.frames))
    rows = np.searchsorted(truth.frames, [estimate.frame for estimate in estimates])
    found = np.array([estimate.joints for estimate in estimates])
    distance = 100 * np.linalg.norm(found - truth.positions[rows], axis=2)  # (F, 15)
    lost = sum(estimate.status == "lost" for estimate in estimates)
    errors = [estimate.residual.sum(axis=1) for estimate in estimates if estimate.residual is not None]  # (F, C)
    error = " ".join(f"{value:.2f}" for value in np.nanmean(errors, axis=0)) if errors else "not measured"
    print(f"{label:28}  {distance.mean():9.2f}  {distance[:, LIMBS].mean():10.2f}  {lost:4}  {error}")
