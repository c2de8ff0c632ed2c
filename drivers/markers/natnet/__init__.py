"""OptiTrack's NatNet protocol, versions 3 and 4, as streamed by Motive; no SDK is needed."""
