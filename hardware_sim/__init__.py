"""What stands across the wire: stimulator, load cell and muscle, in a process of their own."""
