"""What goes in and comes out: captures, videos, results, point clouds."""
