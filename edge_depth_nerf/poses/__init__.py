"""Where the vehicle was: paths by LiDAR, features that pictures share, how well both agree. Pure."""
