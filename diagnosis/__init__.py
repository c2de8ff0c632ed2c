"""Find the named causes of the difference between measured data and the robot's simulation.

`diagnosis.diagnose` goes through the folders: `fit`, `search`, `unnamed`, `assess`; `report` presents the result.
"""
