"""Blind tests of the diagnosis: physical effects are hidden in recordings, and the diagnoses are judged.

The hiding part (`hide` and all that it imports) shares nothing with the code that finds effects: neither formulas,
nor constants, nor helpers. Positions come from pybullet, measurements from pixel coordinates, backlash and springs
from their own equations of motion and balance. The judging part (`judge`, `sealed`, `oracle`, `meaning`) knows both
sides.

`hide.hide` makes a case with these modules, in this order:

| module | what it does |
| --- | --- |
| arms | the described arms, written as URDF |
| choice | which effects, on which arm, at which joints, in which motion |
| motion | the path of the motor shafts and when it is read |
| kinds, outside, sizing | the parameters of effects inside and outside the table, scaled to a size |
| joints | encoders, backlash, lag: from shaft to reading and to true position |
| structure, bullet | the true arm with its springs, and its marker position by pybullet |
| eyes, outliers | the true cameras' pixels, false fixes, and triangulation by the described cameras |
| rendered | the same from painted images and the product's tracker |
| cases, files | recordings with noise and ticks, written out |
| dense_* | arms with tolerances at every link, from generator to judge (`python -m tests.blind.dense`) |
"""
