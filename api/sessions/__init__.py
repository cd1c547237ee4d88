"""A test from the request to its recording, and the service's end of the rig's socket."""
