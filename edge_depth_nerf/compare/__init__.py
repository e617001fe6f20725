"""Fair comparisons: methods that differ in named fields alone, trained and judged alike, and the paper's tables."""
