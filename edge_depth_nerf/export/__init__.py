"""The prior for other programs: maps, a cloud of points, pictures and cameras in formats that they read."""
