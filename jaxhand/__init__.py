"""Tracks hands from labelled optical markers, with holes: the JAX side."""
