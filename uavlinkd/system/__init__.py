"""What the daemon needs of the operating system: addresses, names, clocks, threads, pauses."""
