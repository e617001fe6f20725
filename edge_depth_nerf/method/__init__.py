"""The paper, pure: losses (Eq. 4), integration (Eq. 5-7), alignment, the prior and its error, metrics."""
