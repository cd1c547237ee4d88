"""The pages: server-rendered, offline, plain forms. A file here with a `router` is a page; the others help them."""
