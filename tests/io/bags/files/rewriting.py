"""Copies of MCAP files with other profiles, channels and definitions."""

from mcap.reader import make_reader
from mcap.writer import Writer


def rewrite(
    source, target, profile="ros2", extra=(), schema_of=lambda schema: (schema.encoding, schema.data), **options
):
    """Copy a file of ROS 2; `extra` are topics with type, encodings of schema and messages, and the messages' bytes."""
    with source.open("rb") as old, target.open("wb") as new:
        writer, channels = Writer(new, **options), {}
        writer.start(profile)
        for schema, channel, message in make_reader(old).iter_messages():
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, *schema_of(schema))
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        for topic, name, schema_encoding, definition, encoding, payloads in extra:
            number = writer.register_channel(topic, encoding, writer.register_schema(name, schema_encoding, definition))
            for payload in payloads:
                writer.add_message(number, message.log_time, payload, message.log_time)
        writer.finish()
    return target
