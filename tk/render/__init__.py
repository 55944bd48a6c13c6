"""Images of a result, as PNG or H.264: the body over the videos, a turning 3D view, the hull.

OpenCV draws everything on the CPU: no display and no GPU are needed.
"""
