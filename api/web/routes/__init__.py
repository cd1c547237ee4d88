"""The REST routes: one file a subject, each with a `router`; a new file here is a new subject."""
