"""taojax: am I lost, or just somewhere new, and may this loop closure enter my graph?"""

__version__ = "0.1.0"
