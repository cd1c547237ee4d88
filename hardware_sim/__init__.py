"""The emulated hardware: stimulator, load cell and muscle, in a process of their own."""
