"""The operating system under a stack: families of processes, their reapers and their limits."""
