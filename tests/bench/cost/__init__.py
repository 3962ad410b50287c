"""What a frame costs in user space: instructions and cache lines at each end of a link, counted by callgrind.

A processor that sleeps between two frames finds cold caches, so the simulated caches are emptied before each frame.
The counts depend neither on the machine's speed nor on its load. ``python -m tests.bench.cost``
"""
