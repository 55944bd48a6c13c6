"""Pictures of a result: the body over the videos, a turning view in three dimensions, the hull; as PNG and as H.264.

Everything is drawn by OpenCV on the CPU: no display and no GPU are needed.
"""
