"""The people in a scene: find them, share the pixels, track each, keep their identities."""
