"""Maps of fewer pairs than control points, through the product kernel, with a prior of equal or structured
variance.
"""
