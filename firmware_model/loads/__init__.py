"""Loads on the shaft, one file each; :mod:`firmware_model.registry` finds them."""
