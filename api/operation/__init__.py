"""What who runs a rig needs beside the tests: backup and its drill, the clock, figures for monitoring."""
