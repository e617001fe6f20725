"""KITTI's raw data and odometry benchmark: their calibration and poses, the converter."""
