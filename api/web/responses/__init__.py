"""Responses, typed for the OpenAPI document. Tests check the answers against it; the service itself does not."""
