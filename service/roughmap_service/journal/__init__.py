"""The log: the recorded run in MCAP files.

    records.py          what the log holds, as plain data
    recorder.py         messages and events under their topics; channels.py: topics and schemas
    queue.py            records that wait for the disk; items.py: what can be queued
    writer.py           the log's thread; file_sequence.py: its files in order; file.py: one file
    mcap_writer.py      the bytes of a file; checksums.py: sums them once
    reader.py           one file, read back; run_files.py: a run's files; chunks.py: bounds on memory
    repair.py           repairs torn and damaged files, before a run goes on
    keep.py             deletes the oldest files

Writing uses `LogWriter` and `Recorder`, reading `find_files`, `one_run` and `read_run`.
"""
