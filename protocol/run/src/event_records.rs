//! Records of a TensorBoard event file: the frame around each of its messages.
//!
//! The frame is `length u64 | masked CRC of length u32 | message | masked CRC of message u32`,
//! little-endian. The CRC is CRC-32C. Masking rotates it and adds a constant, so that data that
//! themselves hold checksums still get good ones (TensorFlow's `record_writer.h`).

use std::io::{self, Write};

/// Reason why a record cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EventRecordError {
    /// The bytes end before the record does.
    #[error("truncated")]
    Truncated,
    /// The length does not have its checksum.
    #[error("the checksum of its length is wrong")]
    Length,
    /// The message does not have its checksum.
    #[error("its checksum is wrong")]
    Message,
}

/// Writes a message as one record, and returns the record's length in bytes.
///
/// # Errors
/// The writer's error.
pub fn write_event_record(into: &mut impl Write, message: &[u8]) -> io::Result<u64> {
    let length = (message.len() as u64).to_le_bytes();
    into.write_all(&length)?;
    into.write_all(&masked_crc(&length).to_le_bytes())?;
    into.write_all(message)?;
    into.write_all(&masked_crc(message).to_le_bytes())?;
    Ok(8 + 4 + message.len() as u64 + 4)
}

/// Returns the message of the first record in `bytes`, and the bytes that follow the record.
///
/// # Errors
/// [`EventRecordError`] if the record is truncated or damaged.
pub fn split_event_record(bytes: &[u8]) -> Result<(&[u8], &[u8]), EventRecordError> {
    use EventRecordError::{Length, Message, Truncated};
    let (length, rest) = bytes.split_first_chunk::<8>().ok_or(Truncated)?;
    let (length_crc, rest) = rest.split_first_chunk::<4>().ok_or(Truncated)?;
    if masked_crc(length) != u32::from_le_bytes(*length_crc) {
        return Err(Length);
    }
    let length = usize::try_from(u64::from_le_bytes(*length)).map_err(|_| Truncated)?;
    let (message, rest) = rest.split_at_checked(length).ok_or(Truncated)?;
    let (crc, rest) = rest.split_first_chunk::<4>().ok_or(Truncated)?;
    if masked_crc(message) != u32::from_le_bytes(*crc) {
        return Err(Message);
    }
    Ok((message, rest))
}

fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes)
        .rotate_right(15)
        .wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masking_agrees_with_the_published_vector() {
        // CRC-32C of 32 zero bytes is 8a9136aa (RFC 3720, B.4); rotated right by 15 bits it is
        // 6d551522.
        assert_eq!(crc32c::crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(
            masked_crc(&[0; 32]),
            0x6d55_1522_u32.wrapping_add(0xa282_ead8)
        );
    }

    #[test]
    fn records_read_back_and_a_damaged_byte_anywhere_is_noticed() {
        let mut file = Vec::new();
        assert_eq!(write_event_record(&mut file, b"first").unwrap(), 21);
        write_event_record(&mut file, b"second").unwrap();
        let (message, rest) = split_event_record(&file).unwrap();
        assert_eq!(message, b"first");
        assert_eq!(split_event_record(rest), Ok((&b"second"[..], &b""[..])));
        for index in 0..21 {
            let mut damaged = file.clone();
            damaged[index] ^= 0x10;
            assert!(split_event_record(&damaged).is_err(), "byte {index}");
            let cut = split_event_record(&file[..index]);
            assert_eq!(cut, Err(EventRecordError::Truncated), "{index} bytes");
        }
    }
}
