"""Fair comparisons: methods that differ in named fields alone, trained and evaluated alike, and the paper's tables."""
