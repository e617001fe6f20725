"""Programs that measure the package; README.md lists them."""
