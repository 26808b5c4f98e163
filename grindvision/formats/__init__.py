"""Readers of cloud files, one module per family; ``grindvision.clouds.read_cloud`` is the door.

A reader is given a file that ``grindvision.input_files`` has opened, and its path for messages. A file is not trusted:
sizes in its header are compared with its length before memory is taken, pickles are not loaded, and no other file that
it names is opened.
"""
