"""What images say about a pose: ray costs, surface term, edge term, colours."""
