"""Cameras: devices, image folders and films as `interfaces.protocols.StereoEyes`; see docs/cameras.md."""
