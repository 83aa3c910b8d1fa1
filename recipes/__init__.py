"""The programs of DAMIAN, which the command ``damian`` runs; installed, they are
``damian.recipes``."""
