"""Trainings and other long work as processes of their own, on this machine or a cluster."""
