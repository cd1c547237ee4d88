"""The front doors: REST, page, command line. Never imports a driver."""
