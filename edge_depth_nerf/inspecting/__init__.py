"""`edge-depth-nerf inspect`: a scene as pictures, figures and warnings."""
