"""Convert OpenCap's camera parameters to a calibration.toml: python convert_opencap.py SESSION.

Opening a pickle can run any code in it: use this only for sessions whose source you trust.
"""

import pickle
import sys
from pathlib import Path

import cv2
import numpy as np
import tomli_w

session = Path(sys.argv[1])
tables = {"metadata": {"units": "mm"}}
for file in sorted(session.glob("Videos/*/cameraIntrinsicsExtrinsics.pickle")):
    camera = pickle.loads(file.read_bytes())
    height, width = np.ravel(camera["imageSize"])
    tables[file.parent.name] = {
        "size": [int(width), int(height)],
        "matrix": np.asarray(camera["intrinsicMat"]).tolist(),
        "distortions": np.ravel(camera["distortion"])[:5].tolist(),
        "rotation": np.ravel(cv2.Rodrigues(np.asarray(camera["rotation"], float))[0]).tolist(),
        "translation": np.ravel(camera["translation"]).tolist(),
    }
(session / "calibration.toml").write_text(tomli_w.dumps(tables))
