"""ROS bags: what is in them, and how it becomes a recording that `process rig` reads."""
