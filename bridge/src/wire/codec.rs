//! The codecs of the item types: the body of a message behind its header ([`wire`](super)).
//!
//! Images and ellipses have their own compressors ([`depth_codec`], [`ellipse_codec`]); objects and tracks are in bincode. Items
//! of any other type are sent as in memory: a byte for the compression, their count as a little-endian `u32`, and their bytes,
//! compressed if the lists are long. Their layout has no padding, and both machines have the same one.

use super::compression::{of_tag, pack, tag_of, unpack};
use super::encoding::{MAX_MESSAGE, WireError, decode_whole, encode};
use super::{depth_codec, ellipse_codec};
use bytemuck::{cast_slice, cast_slice_mut, try_cast_slice};
use conicflow_dataflow::ItemType;
use conicflow_dataflow::pipeline::Compression;
use conicflow_messages::{Ellipse, Header, Item, Object, Track};
use serde::Serialize;
use serde::de::DeserializeOwned;

#[cfg(target_endian = "big")]
compile_error!("items go over the wire as they lie in memory, with the lowest byte of a number first");

/// The most pixels of an image that goes to another machine.
const MAX_WIRE_PIXELS: u64 = 16 << 20;

/// A type of items with its own encoding on the wire; by default that of bincode.
trait Form: Item + Serialize + DeserializeOwned {
    /// Appends the body of a message.
    fn encode_body(_: &Header, items: &[Self], _: Compression, bytes: &mut Vec<u8>) -> Result<(), WireError> {
        encode(&items, bytes)
    }

    /// Decodes the body of a message into `items`.
    fn decode_body(_: &Header, bytes: &[u8], items: &mut Vec<Self>) -> Result<(), WireError> {
        *items = decode_whole(bytes)?;
        Ok(())
    }
}

impl Form for Object {}

impl Form for Track {}

impl Form for u16 {
    fn encode_body(header: &Header, items: &[u16], how: Compression, bytes: &mut Vec<u8>) -> Result<(), WireError> {
        check_pixels(header)?;
        Self::check(header, items)?;
        bytes.push(tag_of(how));
        depth_codec::compress(items, header.camera.width as usize, how, bytes).map_err(WireError::Broken)
    }

    fn decode_body(header: &Header, bytes: &[u8], items: &mut Vec<u16>) -> Result<(), WireError> {
        check_pixels(header)?;
        let (how, packed) = split_compression(bytes)?;
        let size = (header.camera.width as usize, header.camera.height as usize);
        depth_codec::decompress(packed, size, how, items).map_err(WireError::Broken)
    }
}

impl Form for Ellipse {
    fn encode_body(header: &Header, items: &[Self], how: Compression, bytes: &mut Vec<u8>) -> Result<(), WireError> {
        bytes.push(tag_of(how));
        if how == Compression::None {
            return encode(&items, bytes);
        }
        if size_of_val(items) > MAX_MESSAGE {
            return Err(WireError::TooLong { bytes: size_of_val(items) });
        }
        ellipse_codec::compress(header, items, how, bytes).map_err(WireError::Broken)
    }

    fn decode_body(header: &Header, bytes: &[u8], items: &mut Vec<Self>) -> Result<(), WireError> {
        let (how, packed) = split_compression(bytes)?;
        match how {
            Compression::None => *items = decode_whole(packed)?,
            _ => ellipse_codec::decompress(header, packed, how, items).map_err(WireError::Broken)?,
        }
        Ok(())
    }
}

fn check_pixels(header: &Header) -> Result<(), WireError> {
    let (width, height) = (header.camera.width, header.camera.height);
    if u64::from(width) * u64::from(height) > MAX_WIRE_PIXELS {
        return Err(WireError::Broken(format!("an image of {width}x{height}, allowed are {MAX_WIRE_PIXELS} pixels")));
    }
    Ok(())
}

/// Returns the compression of a body, and the bytes that follow.
fn split_compression(bytes: &[u8]) -> Result<(Compression, &[u8]), WireError> {
    let (&tag, packed) = bytes.split_first().ok_or_else(|| WireError::Broken("no body".to_owned()))?;
    Ok((of_tag(tag).map_err(WireError::Broken)?, packed))
}

/// Encodes and decodes the items of one type.
pub(crate) trait Codec: Send {
    /// Appends the body of a message with these items, which are as in memory.
    fn encode(&self, header: &Header, items: &[u8], how: Compression, bytes: &mut Vec<u8>) -> Result<(), WireError>;

    /// Decodes and checks the items in the body of a message.
    fn decode(&mut self, header: &Header, bytes: &[u8]) -> Result<(), WireError>;

    /// The items that were decoded last, as in memory.
    fn items(&self) -> &[u8];
}

/// Returns the codec of a type.
pub(crate) fn codec_of(item: &ItemType) -> Box<dyn Codec> {
    match item.name() {
        u16::NAME => Box::new(Known::<u16>(Vec::new())),
        Ellipse::NAME => Box::new(Known::<Ellipse>(Vec::new())),
        Object::NAME => Box::new(Known::<Object>(Vec::new())),
        Track::NAME => Box::new(Known::<Track>(Vec::new())),
        _ => Box::new(AsInMemory { item: item.clone(), items: Vec::new() }),
    }
}

/// The codec of a type with its own encoding.
struct Known<T>(Vec<T>);

impl<T: Form> Codec for Known<T> {
    fn encode(&self, header: &Header, items: &[u8], how: Compression, bytes: &mut Vec<u8>) -> Result<(), WireError> {
        if let Ok(items) = try_cast_slice(items) {
            return T::encode_body(header, items, how, bytes);
        }
        // The bytes are not aligned for the type.
        let whole = items.len() / size_of::<T>();
        let mut aligned = vec![T::zeroed(); whole];
        cast_slice_mut(&mut aligned).copy_from_slice(&items[..whole * size_of::<T>()]);
        T::encode_body(header, &aligned, how, bytes)
    }

    fn decode(&mut self, header: &Header, bytes: &[u8]) -> Result<(), WireError> {
        T::decode_body(header, bytes, &mut self.0)?;
        Ok(T::check(header, &self.0)?)
    }

    fn items(&self) -> &[u8] {
        cast_slice(&self.0)
    }
}

/// The codec of all other types: items as in memory.
struct AsInMemory {
    item: ItemType,
    items: Vec<u8>,
}

impl Codec for AsInMemory {
    fn encode(&self, _: &Header, items: &[u8], how: Compression, bytes: &mut Vec<u8>) -> Result<(), WireError> {
        let how = if self.item.is_short() { Compression::None } else { how };
        if items.len() > MAX_MESSAGE {
            return Err(WireError::TooLong { bytes: items.len() });
        }
        let count = (items.len() / self.item.size()) as u32;
        bytes.push(tag_of(how));
        bytes.extend(count.to_le_bytes());
        bytes.extend_from_slice(&pack(how, items).map_err(WireError::Broken)?);
        Ok(())
    }

    fn decode(&mut self, header: &Header, bytes: &[u8]) -> Result<(), WireError> {
        let (how, rest) = split_compression(bytes)?;
        let broken = |what: &str| WireError::Broken(what.to_owned());
        let (count, packed) = rest.split_first_chunk::<4>().ok_or_else(|| broken("a list without its length"))?;
        let length = (u32::from_le_bytes(*count) as usize).checked_mul(self.item.size());
        let length = length.filter(|length| *length <= MAX_MESSAGE);
        let length = length.ok_or_else(|| broken("a list that claims to be longer than a message may be"))?;
        let unpacked = unpack(how, packed, length).map_err(WireError::Broken)?;
        self.items.clear();
        self.items.extend_from_slice(&unpacked);
        Ok(self.item.check(header, &self.items)?)
    }

    fn items(&self) -> &[u8] {
        &self.items
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Camera, Velocity};

    fn header() -> Header {
        let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
        Header { camera, depth_scale: 0.001, ..Header::default() }
    }

    /// Encodes and decodes items; returns them as in memory.
    fn sent(item: &ItemType, items: &[u8]) -> Result<Vec<u8>, WireError> {
        let (mut codec, mut bytes) = (codec_of(item), Vec::new());
        codec.encode(&header(), items, Compression::Zstd, &mut bytes)?;
        codec.decode(&header(), &bytes)?;
        Ok(codec.items().to_vec())
    }

    #[test]
    fn items_without_an_encoding_of_their_own_are_decoded_bit_for_bit() {
        let item = ItemType::of::<Velocity>();
        for count in [0, 1, 7] {
            let items: Vec<_> =
                (0..count).map(|index| Velocity { linear: [f64::from(index); 3], ..Velocity::default() }).collect();
            assert_eq!(sent(&item, cast_slice(&items)).unwrap(), cast_slice::<_, u8>(&items));
        }
        let nonsense = [Velocity { linear: [f64::NAN; 3], ..Velocity::default() }];
        assert!(matches!(sent(&item, cast_slice(&nonsense)), Err(WireError::Malformed(_))));
    }

    #[test]
    fn each_item_type_has_its_encoding_on_the_wire() {
        let form = |item: ItemType| {
            let mut bytes = Vec::new();
            codec_of(&item).encode(&header(), &[], Compression::None, &mut bytes).unwrap();
            bytes
        };
        assert_eq!([form(ItemType::of::<Object>()), form(ItemType::of::<Track>())], [[0], [0]], "a count");
        assert_eq!(form(ItemType::of::<Ellipse>()), [0, 0], "how it is compressed, and a count");
        assert_eq!(form(ItemType::of::<Velocity>()), [0; 5], "the same with a count of four bytes");
    }

    #[test]
    fn items_are_encoded_from_memory_of_any_alignment() {
        let objects = [1.0, 2.0].map(|radius| Object { radius, ..Object::default() });
        for shift in 0..align_of::<Object>() {
            let bytes = [&vec![0; shift], cast_slice(&objects)].concat();
            let back = sent(&ItemType::of::<Object>(), &bytes[shift..]).unwrap();
            assert_eq!(back, cast_slice::<_, u8>(&objects), "{shift}");
        }
    }

    #[test]
    fn lists_and_images_that_are_too_long_for_a_message_are_not_encoded() {
        let longer = |size: usize| vec![0; (MAX_MESSAGE / size + 1) * size];
        for (item, size) in
            [(ItemType::of::<Ellipse>(), size_of::<Ellipse>()), (ItemType::of::<Velocity>(), size_of::<Velocity>())]
        {
            let items = longer(size);
            assert_eq!(sent(&item, &items), Err(WireError::TooLong { bytes: items.len() }));
        }
        let of_height = |height| {
            let camera = Camera { width: 4096, height, ..header().camera };
            check_pixels(&Header { camera, ..header() })
        };
        assert!(of_height(4096).is_ok() && of_height(4097).is_err());
    }

    #[test]
    fn a_list_that_is_not_what_it_claims_is_refused() {
        let (mut codec, mut good) = (codec_of(&ItemType::of::<Velocity>()), Vec::new());
        codec.encode(&header(), cast_slice(&[Velocity::default(); 2]), Compression::Zstd, &mut good).unwrap();
        assert_eq!(codec.decode(&header(), &good), Ok(()));
        for claim in [0, 1, 3, 1_000_000, u32::MAX] {
            let claimed = [&good[..1], &claim.to_le_bytes(), &good[5..]].concat();
            assert!(matches!(codec.decode(&header(), &claimed), Err(WireError::Broken(_))), "{claim}");
            assert_eq!(codec.decode(&header(), &good), Ok(()), "after {claim}");
        }
        for cut in [0, 1, 4, 5, good.len() - 1] {
            assert!(codec.decode(&header(), &good[..cut]).is_err(), "{cut}");
            assert_eq!(codec.decode(&header(), &good), Ok(()), "after a cut at {cut}");
        }
        let unknown = [&[9], &good[1..]].concat();
        assert!(codec.decode(&header(), &unknown).is_err());
        for place in 5..good.len() {
            let mut damaged = good.clone();
            damaged[place] ^= 0x55;
            codec.decode(&header(), &damaged).ok();
            assert_eq!(codec.decode(&header(), &good), Ok(()), "after damage at {place}");
        }
    }
}
