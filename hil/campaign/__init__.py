"""Campaigns: the same run over many cases, on one machine or a cluster."""
