"""What the daemon needs of the operating system: addresses, clocks, threads, pauses."""
