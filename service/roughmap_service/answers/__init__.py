"""Queries and updates: what readers ask for, and what is published to them.

The way of a query:

    queryables.py   a query arrives, is admitted, planned, queued and answered: `Answers`, the steps in one screen
    question.py     the query itself: its limits, its replies, its error, its record in the log
    tiles.py, region.py, cells.py, operations.py
                    one file per kind of query: parse, check, count cells (`Plan`), then draw the replies
    queue.py        which planned query runs next
    map_reader.py   reads one state of the map for a plan
    drawing.py      draws tiles of that state; tile_cache.py keeps them, drawn_tile.py adds what changes per reply
    emptied_tiles.py
                    the tiles that were emptied, for readers who hold them

`updates.py` publishes changed tiles with the same drawing and cache, `events.py` publishes events. `records.py` logs
what was answered and published.

Other rooms import `MapReader` (map_reader.py), `Answers` (queryables.py), `Updates` (updates.py), `EventPublisher`
(events.py), `OutputRecords` (records.py), `EmptiedHistory` (emptied_tiles.py) and `ServedMap` (served_map.py); the rest
is internal.
"""
