"""OptiTrack's NatNet protocol, versions 3 and 4, as Motive streams it: no SDK is needed."""
