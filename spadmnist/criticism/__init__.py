"""Criticism: a model set beside measurements. Where does it fail, and by how much?"""
