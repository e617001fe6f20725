"""Masks: the lens circle, the recording vehicle, moving things, the sky. Pure: arrays in, arrays out."""
