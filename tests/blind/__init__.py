"""Hides effects in recordings by their physics, for whoever claims to find them.

It shares nothing with the code that finds effects: neither formulas, nor constants, nor helpers. Positions come from
pybullet, measurements from pixel coordinates, gear play and springs from their own equations of motion and balance.
"""
