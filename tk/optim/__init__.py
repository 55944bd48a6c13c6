"""How a pose is found: optimisers that know an objective as a callable of a batch of poses, and no body."""
