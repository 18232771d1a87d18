"""The one writer: the thread that numbers messages, decides clouds and changes the map; recovery before it starts.

    sequencer.py    the thread and its turns: messages, commands, one cloud, what is due
    live_run.py     what a turn does: check a message, log it, apply it; decide a cloud, place it, log its event
    notices.py      what an operator should see of messages; figures.py: of those that were lost
    control.py      operators' requests: snapshot, reset, forget
    recovery.py     from store and log to the run as it was; newest_run.py: finds and repairs its log files
    warmup.py       compiles kernels before the first scan

Other rooms import `Sequencer`, `LiveRun`, `Control`, `recover`, `begin_new_run` and `warm_up`.
"""
