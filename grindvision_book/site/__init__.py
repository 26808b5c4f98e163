"""The HTML book: its pages, pictures and 3D scenes; it needs no network to build or to read."""

from grindvision_book.site.building import PDF, build_site

__all__ = ["PDF", "build_site"]
