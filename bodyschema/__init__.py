"""Robot kinematics that calibrates itself. The folders beside this file are the parts; `kbmaps` is the maths."""


def __getattr__(name: str) -> str:
    if name != "__version__":
        raise AttributeError(f"module 'bodyschema' has no attribute {name!r}")
    from importlib.metadata import version

    return version("bodyschema")
