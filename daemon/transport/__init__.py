"""The zenoh side: keys, messages, access."""
