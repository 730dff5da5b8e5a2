"""Parametric objects and the vocabulary that names them."""
