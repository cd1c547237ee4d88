"""The centre's pages. A file here with a `router` is a page; the others help them."""
