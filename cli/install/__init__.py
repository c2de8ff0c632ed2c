"""Install services, udev rules and routers; back up and restore."""
