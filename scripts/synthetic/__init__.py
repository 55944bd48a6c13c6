"""A capture rendered from nothing: an implicit, clothed actor in a textured room, seen by a calibrated rig.

The actor is a smooth blend of distance functions on its own skeleton (36 joints, three of them in the spine). It shares
no shape and no kinematics with the trackers in `tk`, so that tracking it proves something.
"""
