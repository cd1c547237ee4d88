"""What breaks, when: a fault is one function marked `@fault` in any file of this folder, found by scanning."""
