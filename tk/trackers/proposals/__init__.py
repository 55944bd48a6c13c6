"""Proposals of poses. Each module has one function ``propose``, which takes the tracker, what a frame shows, and the
present pose, and returns other poses (B, D), settled at the coarser scales. It decides nothing: the tracker settles
them at the finest scale, compares all poses by one cost, and chooses."""
