"""Proposals of poses. The function ``propose`` of each module takes what a frame shows and what it proposes beside, and
returns other poses (B, D). It decides nothing: the tracker settles them at the finest scale, compares all poses by one
cost, and chooses."""
