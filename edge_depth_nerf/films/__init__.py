"""Films: paths of a camera through a trained scene, in the form that `ns-render camera-path` reads."""
