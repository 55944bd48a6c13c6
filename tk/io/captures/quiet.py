"""Keep OpenCV and FFmpeg from writing to the user's terminal: what they complain about, we report in one line.

Importing this module is enough. A user who wants their messages sets ``OPENCV_LOG_LEVEL`` or
``OPENCV_FFMPEG_LOGLEVEL``, which then stay as they are.
"""

from __future__ import annotations

import os

import cv2

# FFmpeg's AV_LOG_QUIET; OpenCV reads it when it opens the first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

# OpenCV itself reads its variable on import, which has happened: tell it directly.
if "OPENCV_LOG_LEVEL" not in os.environ:
    _silent = 0
    _set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel  # OpenCV 4, OpenCV 5
    _set_log_level(_silent)
