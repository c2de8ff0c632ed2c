"""Robot kinematics that calibrates itself; `kbmaps` is the maths.

In the repository the folders beside this file are symbolic links to those at its top, where the code is.
"""


def __getattr__(name: str) -> str:
    if name != "__version__":
        raise AttributeError(f"module 'bodyschema' has no attribute {name!r}")
    from importlib.metadata import version

    return version("bodyschema")
