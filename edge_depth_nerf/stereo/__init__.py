"""Distance from motion: what a picture's neighbours, whose poses are known, say of how far things are."""
