"""Find the named causes of the difference between measured data and the robot's simulation.

`diagnosis.diagnose` goes through the folders: `fit`, `search`, `unnamed`, `assess`; `report` presents the result.

An *unnamed* cause is one that no effect describes. The remaining error beside named causes is the *residual structure*.
The verdict, the key in files and `effects.Unexplained`, its stored model, call it *unexplained*.
"""
