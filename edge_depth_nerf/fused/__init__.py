"""nerfacto's other parts in fused kernels: the same numbers, in fewer passes over memory."""
