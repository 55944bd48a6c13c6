"""What things are: cameras, the working volume, the skeleton, the body's surface, its colours."""
