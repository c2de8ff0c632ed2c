"""Maps of fewer pairs than control points, learnt through the product kernel (a covariance, not compiled code)."""
