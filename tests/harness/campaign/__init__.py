"""The fault campaign: each fault, in each phase of a test, on several seeds."""
