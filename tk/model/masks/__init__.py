"""Masks: background model, cleaning, consistency between cameras."""
