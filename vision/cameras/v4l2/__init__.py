"""One camera of Video4Linux: its device, controls, capture and serial number."""
