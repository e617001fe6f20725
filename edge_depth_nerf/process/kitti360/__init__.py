"""KITTI-360's raw layout: calibration, the drive's files, the converter."""
