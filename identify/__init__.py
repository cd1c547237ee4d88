"""Identification and criticism of electrically stimulated muscle. Pure: arrays in, model out."""
