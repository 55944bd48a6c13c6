"""What can be checked before a capture is tracked."""
