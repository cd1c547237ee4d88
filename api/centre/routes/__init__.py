"""The centre's REST routes: one file a subject, each with a `router`."""
