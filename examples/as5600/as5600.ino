// AS5600 magnetic encoders as joint encoders of bodyschema: says the lines that drivers/serial_lines reads.
// For Arduino (Uno, Nano, Leonardo, ...) and ESP32. docs/hardware.md defines the lines, README.md tells the wiring.

// --- what is yours

const char* const NAMES[] = {"shoulder", "elbow", "wrist"};  // letters, digits, _ and -; in the order of the channels
#define USE_MULTIPLEXER 1                                    // 0: one encoder without TCA9548A
const unsigned long BAUD = 115200;
const uint32_t PERIOD_US = 5000;  // 200 lines a second

// --- the lines

#include <stdint.h>

const int VERSION = 1;
const long TICKS_PER_TURN = 4096;
const uint16_t CRC_POLYNOMIAL = 0x1021;
const uint16_t CRC_INITIAL = 0xFFFF;

uint16_t crc_add(uint16_t crc, uint8_t byte) {
  crc ^= (uint16_t)byte << 8;
  for (int bit = 0; bit < 8; bit++) {
    crc = (crc & 0x8000) ? (uint16_t)((crc << 1) ^ CRC_POLYNOMIAL) : (uint16_t)(crc << 1);
  }
  return crc;
}

#ifdef ARDUINO  // what follows needs a board

#include <Arduino.h>
#include <Wire.h>

const uint8_t MULTIPLEXER = 0x70;
const uint8_t ENCODER = 0x36;
const uint8_t STATUS_REGISTER = 0x0B;  // and the raw angle right behind it
const uint8_t MAGNET_DETECTED = 0x20;
const uint32_t HEADER_EVERY_MS = 1000;
const int COUNT = sizeof(NAMES) / sizeof(NAMES[0]);

uint16_t boot_number;
uint16_t sequence = 0;
uint32_t next_us;
uint32_t header_ms;
uint16_t crc;

void put(const char* text) {
  for (; *text; text++) {
    crc = crc_add(crc, (uint8_t)*text);
    Serial.write(*text);
  }
}

void put(unsigned long number) {
  char text[12];
  ultoa(number, text, 10);
  put(text);
}

void begin_line() { crc = CRC_INITIAL; }

void end_line() {
  const char* digits = "0123456789ABCDEF";
  Serial.write('*');
  for (int shift = 12; shift >= 0; shift -= 4) Serial.write(digits[(crc >> shift) & 0xF]);
  Serial.write('\n');
}

void say_header() {
  begin_line();
  put("H,");
  put((unsigned long)VERSION);
  put(",");
  put((unsigned long)boot_number);
  put(",");
  put((unsigned long)COUNT);
  for (int k = 0; k < COUNT; k++) {
    put(",");
    put(NAMES[k]);
    put(",");
    put((unsigned long)TICKS_PER_TURN);
  }
  end_line();
  header_ms = millis();
}

// The raw angle of encoder k, or -1 where there is none.
int raw_angle(int k) {
#if USE_MULTIPLEXER
  Wire.beginTransmission(MULTIPLEXER);
  Wire.write((uint8_t)(1 << k));
  if (Wire.endTransmission() != 0) return -1;
#else
  (void)k;
#endif
  Wire.beginTransmission(ENCODER);
  Wire.write(STATUS_REGISTER);
  if (Wire.endTransmission(false) != 0) return -1;
  if (Wire.requestFrom(ENCODER, (uint8_t)3) != 3) return -1;
  uint8_t status = Wire.read();
  uint8_t high = Wire.read();
  uint8_t low = Wire.read();
  if (!(status & MAGNET_DETECTED)) return -1;
  return ((high & 0x0F) << 8) | low;
}

void say_reading() {
  int angles[COUNT];
  uint32_t begun = micros();
  for (int k = 0; k < COUNT; k++) angles[k] = raw_angle(k);
  uint32_t middle = begun + ((uint32_t)micros() - begun) / 2;
  begin_line();
  put((unsigned long)sequence++);
  put(",");
  put((unsigned long)middle);
  for (int k = 0; k < COUNT; k++) {
    put(",");
    if (angles[k] < 0) put("-");
    else put((unsigned long)angles[k]);
  }
  end_line();
}

void setup() {
  Serial.begin(BAUD);
  Wire.begin();
  Wire.setClock(400000);
#if defined(ESP32)
  boot_number = (uint16_t)esp_random();
#else
  for (int k = 0; k < 16; k++) boot_number = (boot_number << 1) ^ (uint16_t)analogRead(A0) ^ (uint16_t)micros();
#endif
  say_header();
  next_us = micros();
}

void loop() {
  while (Serial.available()) {
    if (Serial.read() == '?') say_header();
  }
  if ((int32_t)(micros() - next_us) < 0) return;
  next_us += PERIOD_US;
  if ((int32_t)(micros() - next_us) > 0) next_us = micros() + PERIOD_US;  // too slow for this rate: leave lines out
  say_reading();
  if ((uint32_t)millis() - header_ms >= HEADER_EVERY_MS) say_header();
}

#endif
