"""A scene in the browser: what its states look like, what changed between them, and things to be moved by hand.

The browser draws splats, boxes and cameras; what it draws sharp when the view stands still is the field's own picture.
viser (the extra 'view') is imported late, by whoever opens a server.
"""
