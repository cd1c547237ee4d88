"""Clients that generators make of our OpenAPI document, on a controller's whole day."""
