"""Several muscles at one joint, from one test: identified together, criticised, inverted for a controller."""
