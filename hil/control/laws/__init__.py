"""Drive laws, one file each: keys, design; the kernels are in :mod:`hil.control.law`."""
