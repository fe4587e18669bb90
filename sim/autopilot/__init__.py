"""A program in the flight controller's place: PX4's simulator protocol, in lockstep."""
