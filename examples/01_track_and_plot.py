"""Track a person and plot how the knees bend and how high the wrists are.

    python examples/01_track_and_plot.py [CAPTURE] [--frames 45] [--out tracked] [--config FILE]

Without CAPTURE it takes the one that ships with tk. Needs matplotlib; the table needs pandas, and is left out without.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import tk
from tk.errors import ExportError

DEMO = Path(tk.__file__).parent / "data" / "demo"

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("capture", nargs="?", type=Path, default=DEMO)
parser.add_argument("--frames", type=int, help="how many; all by default")
parser.add_argument("--out", type=Path, default=Path("tracked"), help="folder")
parser.add_argument("--config", type=Path, help="settings, TOML")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

capture = tk.open_capture(options.capture)
config = tk.read_settings(options.config) if options.config else tk.Settings()
result = tk.track(capture, options.out / "result.h5", frames=(0, options.frames), config=config, force=True)
lost = result.status == 3
print(f"{len(result)} frames, {lost.sum()} lost")

# a lost frame has a pose, too, but not one to be shown
joints = np.where(lost[:, None, None], np.nan, result.joints)  # (F, 15, 3) metres
names = list(result.meta.joint_names)
figure = Figure(figsize=(8, 5), layout="constrained")
above, below = figure.subplots(2, 1, sharex=True)
for side, color in (("l", "tab:red"), ("r", "tab:blue")):
    flexion = result.angles[f"knee_{side}"][:, 0]
    above.plot(result.time, np.where(lost, np.nan, flexion), color=color, label=f"knee_{side}")
    wrist = names.index(f"wrist_{side}")
    height, sigma = joints[:, wrist, 2], result.sigma[:, wrist]
    below.plot(result.time, height, color=color, label=f"wrist_{side}")
    below.fill_between(result.time, height - sigma, height + sigma, color=color, alpha=0.2)
above.set(ylabel="flexion [°]", title=f"{capture.name}: what the person does")
below.set(ylabel="height and its σ [m]", xlabel="time [s]")
above.legend()
below.legend()
figure.savefig(options.out / "motion.png", dpi=100)
print(f"wrote {options.out / 'motion.png'}")

try:
    result.to_pandas().to_csv(options.out / "result.csv")
    print(f"wrote {options.out / 'result.csv'}")
except ExportError as missing:
    print(f"no table: {missing}")
