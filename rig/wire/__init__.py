"""Encoders and decoders of the wire protocols. Pure: no port is opened here."""
