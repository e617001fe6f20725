"""Synthetic drives: scenes, ray casting and sensors, written in KITTI-360's raw layout with the ground truth beside it.

`options.SynthesizeOptions` says what to make and imports nothing heavy; `drive.synthesize_drive` makes it.
"""
