"""The web service: REST routes, pages, and what guards both."""
