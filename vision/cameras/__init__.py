"""Cameras: devices, image folders and films as `bodyschema.interfaces.protocols.StereoEyes`; see docs/cameras.md."""
