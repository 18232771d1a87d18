"""From the network to the queue: the Zenoh session, subscriptions, the input queue, admission and receipts."""
